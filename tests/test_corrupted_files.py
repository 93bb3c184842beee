"""Corrupted files are refused in one sentence, and nothing in them is ever run."""

import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import corruptions
import numpy as np
import pytest
from file_kinds import CHUNK, KINDS, SCENE
from fuzz_files import OUTCOMES, outcome, shapes_of

from torchrl_nerd.checkpoint import from_pretrained, load_checkpoint
from torchrl_nerd.data import generate as generation
from torchrl_nerd.data.generate import load_data
from torchrl_nerd.data.log_files import LARGEST_LOG, read_log
from torchrl_nerd.data.store import chunk_path, read_chunk, write_chunk
from torchrl_nerd.evaluation.policy import load_policy
from torchrl_nerd.files import read_json, write_json
from torchrl_nerd.robots import load_scene
from torchrl_nerd.training.log import TrainingLog

FILES = 12  # of each kind
TOOLS = Path(__file__).parent / "tools"


@pytest.fixture(autouse=True)
def small(monkeypatch):
    monkeypatch.setattr(generation, "CHUNK", CHUNK)
    monkeypatch.setattr(corruptions, "BOMB", 2**20)


@pytest.fixture(params=KINDS)
def kind(request) -> str:
    return request.param


def make(kind: str, folder: Path) -> Path:
    folder.mkdir()
    KINDS[kind].make(folder)
    return folder


def rewrite_chunk(folder: Path, number: int, change: Callable) -> None:
    path = chunk_path(folder, number)
    write_chunk(change(read_chunk(path, 2).clone()), path)


def edit(path: Path, **changes: object) -> None:
    write_json(path, {**read_json(path), **changes})


def test_corrupted_files_are_refused_or_sound(kind, tmp_path, rng):
    sound, marker = make(kind, tmp_path / "sound"), tmp_path / "marker"
    shapes = shapes_of(KINDS[kind].load(shutil.copytree(sound, tmp_path / "copy")))
    for _ in range(FILES):
        place = shutil.copytree(sound, tmp_path / "corrupted")
        done = corruptions.corrupt(place, rng, marker)
        said = outcome(KINDS[kind], place, shapes)
        assert said in OUTCOMES and not marker.exists(), f"{done}: {said}"
        shutil.rmtree(place)
        assert len(list(tmp_path.iterdir())) == 2, f"{done}: a file outside"


@pytest.mark.parametrize("change", [-8, 8])
def test_a_data_file_of_another_size_is_refused_and_left(change, tmp_path):
    path = chunk_path(make("data", tmp_path / "data"), 0)
    size = path.stat().st_size + change
    with open(path, "rb+") as file:
        file.truncate(size)
    with pytest.raises(ValueError, match="chunk-00000.safetensors is truncated or no"):
        load_data(load_scene(SCENE), path.parent)
    assert path.stat().st_size == size


def test_a_missing_chunk_and_a_chunk_of_another_set_are_refused(tmp_path):
    folder = make("data", tmp_path / "data")
    shutil.copy(chunk_path(folder, 0), chunk_path(folder, 1))
    rewrite_chunk(folder, 1, lambda data: data[:1])
    with pytest.raises(ValueError, match=f"expected 6 trajectories in {folder}, found"):
        load_data(load_scene(SCENE), folder)
    chunk_path(folder, 1).unlink()
    with pytest.raises(ValueError, match="chunk-00001.safetensors, found no file"):
        load_data(load_scene(SCENE), folder)


@pytest.mark.parametrize("key", ["qvel", ("next", "joint_torque")])
def test_a_chunk_of_another_layout_is_refused(key, tmp_path):
    folder = make("data", tmp_path / "data")
    name = key if isinstance(key, str) else "/".join(key)
    for change in (
        lambda data: data.exclude(key),
        lambda data: data.set(key, data[key].float()),
        lambda data: data.set(key, data[key][..., :0]),
        lambda data: data.set("extra", data[key]),
    ):
        place = shutil.copytree(folder, tmp_path / "changed")
        rewrite_chunk(place, 0, change)
        with pytest.raises(ValueError, match=f"'{name}' of shape|'extra' of shape"):
            load_data(load_scene(SCENE), place)
        shutil.rmtree(place)


@pytest.mark.parametrize(
    "changes",
    [{"trajectories": None}, {"trajectories": 7}, {"dropped": -1}, {"config": None}],
    ids=str,
)
def test_a_data_card_with_impossible_counts(changes, tmp_path):
    folder = make("data", tmp_path / "data")
    edit(folder / "data.json", **changes)
    with pytest.raises(ValueError, match="to count trajectories"):
        load_data(load_scene(SCENE), folder)


def test_data_that_are_not_finite(tmp_path, rng):
    folder = make("data", tmp_path / "data")

    def spoil(data):
        values = data["next", "qvel"].view(-1)
        values[rng.integers(len(values))] = np.nan
        return data

    rewrite_chunk(folder, 0, spoil)
    with pytest.raises(ValueError, match="expected finite numbers in .*next/qvel"):
        load_data(load_scene(SCENE), folder)


@pytest.mark.parametrize(
    "network",
    [
        {"kind": "mlp", "width": 2**14, "depth": 2**14},
        {"kind": "mlp", "width": 2**14, "depth": 2},
        {"kind": "gru", "width": 2**14, "layers": 2**14},
        {"kind": "transformer", "width": 2**14, "layers": 2, "heads": 2, "band": 2},
    ],
    ids=str,
)
def test_a_card_cannot_ask_for_more_memory_than_its_weights(network, tmp_path):
    folder = make("checkpoint", tmp_path / "model")
    edit(folder / "card.json", network=network)
    with pytest.raises(ValueError, match="weights are too few"):
        load_checkpoint(folder)


@pytest.mark.parametrize("sizes", [[5, 2**14, 2**14, 1], [5, 10**12, 1], [5] * 1000])
def test_nor_can_that_of_a_policy(sizes, tmp_path):
    folder = make("policy", tmp_path / "policy")
    edit(folder / "policy.json", sizes=sizes)
    with pytest.raises(ValueError, match="layers of|expected the layer sizes"):
        load_policy(folder)


def test_a_log_that_unpacks_to_gigabytes_is_not_unpacked(tmp_path, monkeypatch):
    monkeypatch.setattr(corruptions, "BOMB", LARGEST_LOG + 2**25)
    corruptions.bomb.cache_clear()
    path = tmp_path / "log.npz"
    path.write_bytes(corruptions.bomb())
    corruptions.bomb.cache_clear()
    with pytest.raises(ValueError, match="bytes when unpacked"):
        read_log(path, load_scene("cube_real"))


@pytest.mark.parametrize("dtype", [str, complex, "M8[s]", [("a", "f8")]], ids=str)
def test_a_log_of_other_than_numbers(dtype, tmp_path):
    path = tmp_path / "log.npz"
    np.savez(path, position=np.zeros((4, 3), dtype), quaternion_wxyz=np.ones((4, 4)))
    with pytest.raises(ValueError, match="expected an array of numbers in 'position'"):
        read_log(path, load_scene("cube_real"))


@pytest.mark.parametrize(
    "text", ["", "step,loss\n1\n", "loss\n1\n", "step\nx\n", "step\n1,2\n"]
)
def test_a_training_log_that_is_none(text, tmp_path):
    (tmp_path / "log.csv").write_text(text)
    if not text:
        assert TrainingLog(tmp_path, 0).rows == []
        return
    with pytest.raises(ValueError, match="table of metrics by 'step'"):
        TrainingLog(tmp_path, 0)


def test_a_device_is_no_file(tmp_path):
    (tmp_path / "card.json").symlink_to("/dev/zero")
    with pytest.raises(ValueError, match="found no file"):
        read_json(tmp_path / "card.json")


@pytest.mark.parametrize("call", [load_scene, from_pretrained])
@pytest.mark.parametrize("name", ["cart\npole", "a\0b", "x" * 5000, "../../x"])
def test_odd_names_are_refused_in_one_sentence(call, name):
    with pytest.raises(ValueError) as caught:
        call(name)
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.slow
def test_thousands_of_corrupted_files(seed, tmp_path):
    """Each in a process with limits on time and memory."""
    command = [sys.executable, "fuzz_files.py", "--files", "3000", "--seed", str(seed)]
    subprocess.run([*command, "--json", tmp_path / "f.json"], check=True, cwd=TOOLS)
    assert read_json(tmp_path / "f.json")["losses"] == []
