"""A data set that was cut short is finished to the same bits, and never mixed up."""

import os
import shutil
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch

from torchrl_nerd.configs import DataConfig
from torchrl_nerd.data import generate as module
from torchrl_nerd.data.generate import generate, load_data
from torchrl_nerd.files import read_json
from torchrl_nerd.robots import load_scene

CHUNK, CHUNKS = 4, 5
SCENE, OTHER = (load_scene(name) for name in ("cartpole", "double_pendulum"))
CONFIG = DataConfig(trajectories=CHUNK * CHUNKS - 1, steps=3, seed=5)
FIRST = {"simulate": 1, "is_sound": 1, "write_chunk": 1, "write_json": 2}
"""Functions of the module -> the call that belongs to the first chunk."""
MOMENTS = [(name, chunk) for name in FIRST for chunk in range(CHUNKS)]
USUAL = [("simulate", 2), ("write_chunk", 0), ("write_json", CHUNKS - 1)]
"""Tested always; all other moments are slow."""

KILLED = """
import os, signal, sys
from pathlib import Path
from torchrl_nerd.data import generate as module
from torchrl_nerd.robots import load_scene

module.CHUNK = {chunk}
statuses = []
for name, chunk, call in {moments}:
    if child := os.fork():
        statuses.append(os.waitpid(child, 0)[1])
        continue
    original, left = getattr(module, name), [call]

    def dying(*args, **kwargs):
        left[0] -= 1
        if left[0] == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        return original(*args, **kwargs)

    setattr(module, name, dying)
    config = module.DataConfig(**{config})
    folder = Path(sys.argv[1]) / f"{{name}}-{{chunk}}"
    module.generate(load_scene("{scene}"), config, folder, quiet=True)
    os._exit(0)
assert statuses == [signal.SIGKILL] * len(statuses), statuses
"""


@pytest.fixture(autouse=True)
def small_chunks(monkeypatch):
    monkeypatch.setattr(module, "CHUNK", CHUNK)


def kill(moments: list[tuple[str, int]], root: Path) -> Path:
    """Make folders ``function-chunk`` of processes that ended at these moments."""
    calls = [(name, chunk, FIRST[name] + chunk) for name, chunk in moments]
    code = KILLED.format(
        chunk=CHUNK, moments=calls, config=asdict(CONFIG), scene=SCENE.name
    )
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    subprocess.run([sys.executable, "-c", code, str(root)], check=True, env=environment)
    return root


@pytest.fixture(scope="module")
def killed(tmp_path_factory) -> Path:
    """Folders of the usual moments."""
    return kill(USUAL, tmp_path_factory.mktemp("killed"))


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The same data set in one go."""
    folder = tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "CHUNK", CHUNK)
        return load_data(SCENE, generate(SCENE, CONFIG, folder, quiet=True))


def is_equal(data, expected) -> bool:
    keys = set(expected.keys(True, True))
    return set(data.keys(True, True)) == keys and all(
        torch.equal(data[key], expected[key]) for key in keys
    )


def snapshot(folder: Path) -> dict[str, tuple[bytes, int]]:
    return {
        str(path.relative_to(folder)): (path.read_bytes(), path.stat().st_mtime_ns)
        for path in folder.rglob("*")
        if path.is_file()
    }


def assert_finishes(moment: tuple[str, int], root: Path, whole, place: Path) -> None:
    """What was killed at a moment is refused, and finished to the bits of the whole."""
    name, chunk = moment
    folder = shutil.copytree(root / f"{name}-{chunk}", place)
    if (folder / "data.json").exists():
        assert read_json(folder / "data.json")["chunks_done"] == chunk
    with pytest.raises(ValueError, match=r"not finished|found no data\.json"):
        load_data(SCENE, folder)
    generate(SCENE, CONFIG, folder, quiet=True)
    assert is_equal(load_data(SCENE, folder), whole)
    card = read_json(folder / "data.json")
    assert card["trajectories"] + card["dropped"] == CONFIG.trajectories
    assert not list(folder.glob(".*.tmp"))


@pytest.mark.parametrize("moment", USUAL, ids=str)
def test_a_killed_run_goes_on_to_the_same_bits(moment, killed, whole, tmp_path):
    assert_finishes(moment, killed, whole, tmp_path / "killed")


@pytest.mark.slow
def test_at_every_moment(whole, tmp_path):
    kill(MOMENTS, tmp_path)
    for name, chunk in MOMENTS:
        assert_finishes((name, chunk), tmp_path, whole, tmp_path / f"{name}_{chunk}")


def test_a_finished_data_set_is_left_as_it_is(tmp_path):
    generate(SCENE, CONFIG, tmp_path, quiet=True)
    before = snapshot(tmp_path)
    generate(SCENE, CONFIG, tmp_path, quiet=True)
    after = snapshot(tmp_path)
    before.pop("data.json"), after.pop("data.json")
    assert after == before and len(before) > 4


@pytest.mark.parametrize(
    ("name", "value"), [("trajectories", 30), ("steps", 4), ("seed", 6)]
)
def test_another_configuration_is_refused_and_nothing_lost(name, value, tmp_path):
    generate(SCENE, CONFIG, tmp_path, quiet=True)
    before = snapshot(tmp_path)
    with pytest.raises(
        ValueError, match=f"{tmp_path} already holds.*config.{name} .*another folder"
    ):
        generate(SCENE, replace(CONFIG, **{name: value}), tmp_path, quiet=True)
    assert snapshot(tmp_path) == before


def test_another_robot_or_other_ranges_are_refused(tmp_path):
    generate(SCENE, CONFIG, tmp_path, quiet=True)
    before = snapshot(tmp_path)
    calm = replace(SCENE, sampling=replace(SCENE.sampling, zero_torque_fraction=1.0))
    for scene in (OTHER, calm):
        with pytest.raises(ValueError, match=f"{tmp_path} already holds"):
            generate(scene, CONFIG, tmp_path, quiet=True)
        assert snapshot(tmp_path) == before


@pytest.mark.parametrize("change", [{"trajectories": 40}, {"steps": 5}])
def test_a_run_killed_in_its_first_chunk_is_never_mixed_with_another(
    change, killed, tmp_path
):
    config = replace(CONFIG, **change)
    folder = shutil.copytree(killed / "write_chunk-0", tmp_path / "killed")
    try:
        generate(SCENE, config, folder, quiet=True)
    except ValueError as error:
        assert str(folder) in str(error)
    else:
        fresh = generate(SCENE, config, tmp_path / "fresh", quiet=True)
        assert is_equal(load_data(SCENE, folder), load_data(SCENE, fresh))
