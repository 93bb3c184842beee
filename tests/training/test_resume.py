"""A training that was killed at any moment ends in the bits of one that was not."""

import os
import subprocess
import sys
from dataclasses import asdict
from functools import cache
from pathlib import Path

import pytest
import torch
from dynamics_helpers import random_model
from safetensors.torch import load_file
from tensordict import TensorDict
from torch import Generator

from torchrl_nerd.configs import TrainConfig
from torchrl_nerd.data.simulate import simulate
from torchrl_nerd.files import read_json
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.robots import Source, load_scene, make_task
from torchrl_nerd.training.trainer import Trainer

SCENE, TASK = "cartpole", "cartpole/swingup"
CONFIG = TrainConfig(
    steps=14,
    rollout_steps=8,
    batch_size=16,
    sequence_length=6,
    rollout_batch_size=8,
    rollout_length=4,
    warmup=3,
    bf16_fraction=0.5,
    save_every=4,
    validate_every=3,
)
STOPS = [
    pytest.param(6, marks=pytest.mark.slow),
    pytest.param(8, marks=pytest.mark.slow),
    18,
]
"""Where a run is stopped: between saves, right at one, among the rollouts."""
KILLS = {
    "Trainer.update": (1, 7, 15, 20),
    "Trainer.validate": (2,),
    "save_checkpoint": (2, 4, 7),
    "RunState.save": (1, 2, 4),
    "write_json": (1, 2, 5),
}
"""Function of the module -> calls at whose beginning the process is killed."""
MOMENTS = [(name, call) for name, calls in KILLS.items() for call in calls]
USUAL = [("Trainer.update", 15), ("RunState.save", 2), ("write_json", 2)]
"""Tested always: among rollouts, between a model and its state, before the state's card."""

KILLED = """
import os, signal, sys
from functools import reduce
from pathlib import Path
import torch
from torch import Generator
from torchrl_nerd.data.simulate import simulate
from torchrl_nerd.robots import load_scene
from torchrl_nerd.robots import make_task
from torchrl_nerd.training import trainer as module

torch.set_num_threads({threads})
statuses = []
for name, call in {moments}:
    if child := os.fork():
        statuses.append(os.waitpid(child, 0)[1])
        continue
    *path, last = name.split(".")
    owner = reduce(getattr, path, module)
    original, left = getattr(owner, last), [call]

    def dying(*args, **kwargs):
        left[0] -= 1
        if left[0] == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        return original(*args, **kwargs)

    setattr(owner, last, dying)
    scene = load_scene("{scene}")
    data = simulate(scene, 60, 10, Generator().manual_seed(1))
    config = module.TrainConfig(**{config})
    folder = Path(sys.argv[1]) / f"{{name}}-{{call}}"
    task = make_task("{task}")
    module.Trainer(
        scene, data, task, config, folder, horizons=(2, 4), quiet=True
    ).run()
    os._exit(0)
assert statuses == [signal.SIGKILL] * len(statuses), statuses
"""


@cache
def data() -> TensorDict:
    return simulate(load_scene(SCENE), 60, 10, Generator().manual_seed(1))


def make_trainer(
    folder: Path,
    init_from: NeRD | None = None,
    horizons: tuple[int, ...] = (2, 4),
    source: Source | None = None,
) -> Trainer:
    how = {"horizons": horizons, "quiet": True, "init_from": init_from}
    source = source or make_task(TASK)
    return Trainer(load_scene(SCENE), data(), source, CONFIG, folder, **how)


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """The run that nothing interrupted."""
    folder = tmp_path_factory.mktemp("whole")
    make_trainer(folder).run()
    return folder


def kill(moments: list[tuple[str, int]], root: Path) -> Path:
    """Make folders ``function-call`` of runs that ended at that call."""
    code = KILLED.format(
        threads=torch.get_num_threads(),
        moments=moments,
        config=asdict(CONFIG),
        scene=SCENE,
        task=TASK,
    )
    subprocess.run([sys.executable, "-c", code, str(root)], check=True)
    return root


@pytest.fixture(scope="module")
def killed(tmp_path_factory) -> Path:
    """Folders of the usual moments."""
    return kill(USUAL, tmp_path_factory.mktemp("killed"))


def assert_same_bits(folder: Path, expected: Path) -> None:
    for name in ("state", "last/model", "best/model"):
        tensors, others = (
            load_file(root / f"{name}.safetensors") for root in (folder, expected)
        )
        assert tensors.keys() == others.keys()
        differing = [k for k in others if not torch.equal(tensors[k], others[k])]
        assert not differing, f"{name}: {differing}"
    kinds = {key.split(".")[0] for key in load_file(folder / "state.safetensors")}
    assert kinds >= {"model", "average", "muon", "adamw"}
    assert (folder / "log.csv").read_text() == (expected / "log.csv").read_text()
    steps = [
        read_json(root / "best" / "card.json")["training"]["steps_done"]
        for root in (folder, expected)
    ]
    assert steps[0] == steps[1]


@pytest.mark.parametrize("stop", STOPS)
def test_a_stopped_run_resumes_to_the_same_bits(stop, whole, tmp_path):
    make_trainer(tmp_path).run(until=stop)
    resumed = make_trainer(tmp_path)
    assert resumed.step == stop // CONFIG.save_every * CONFIG.save_every
    resumed.run()
    assert_same_bits(tmp_path, whole)


@pytest.mark.slow
def test_a_run_with_a_start_goes_on_to_the_same_bits(tmp_path, generator):
    start = random_model(load_scene(SCENE), generator, CONFIG.network)
    for folder in ("whole", "stopped"):
        until = 18 if folder == "stopped" else None
        make_trainer(tmp_path / folder, start).run(until)
    resumed = make_trainer(tmp_path / "stopped", start)
    assert 0 < resumed.step < CONFIG.total_steps
    resumed.run()
    assert_same_bits(tmp_path / "stopped", tmp_path / "whole")
    other = random_model(load_scene(SCENE), generator, CONFIG.network)
    for another in (other, None):
        with pytest.raises(ValueError, match="stopped holds a run with init_from"):
            make_trainer(tmp_path / "stopped", another)


def assert_resumes(moment: tuple[str, int], root: Path, whole: Path) -> None:
    """What was killed at a moment resumes from its last save to the bits of the whole."""
    folder = root / "{}-{}".format(*moment)
    resumed = make_trainer(folder)
    assert resumed.step % CONFIG.save_every == 0
    resumed.run()
    assert_same_bits(folder, whole)
    assert not list(folder.rglob(".*.tmp"))


@pytest.mark.parametrize("moment", USUAL, ids=str)
def test_a_killed_run_resumes_to_the_same_bits(moment, killed, whole):
    assert_resumes(moment, killed, whole)


@pytest.mark.slow
def test_at_every_moment(whole, tmp_path):
    kill(MOMENTS, tmp_path)
    for moment in MOMENTS:
        assert_resumes(moment, tmp_path, whole)


def test_a_finished_run_is_left_as_it_is(whole):
    before = {p: p.read_bytes() for p in whole.rglob("*") if p.is_file()}
    trainer = make_trainer(whole)
    assert trainer.step == CONFIG.total_steps
    model = trainer.run()
    tensors = load_file(whole / "last" / "model.safetensors")
    state = model.state_dict()
    assert all(torch.equal(tensors[key], value) for key, value in state.items())
    after = {p: p.read_bytes() for p in whole.rglob("*") if p.is_file()}
    boards = [p for p in after if "tensorboard" in p.parts]
    assert {k: v for k, v in after.items() if k not in boards} == {
        k: v for k, v in before.items() if k not in boards
    }


def test_a_run_is_not_continued_with_other_validations(whole):
    """Its table would have other columns, its best model another measure."""
    with pytest.raises(ValueError, match="holds a run with validation"):
        make_trainer(whole, horizons=(3,))
    with pytest.raises(ValueError, match="holds a run with validation"):
        make_trainer(whole, source=load_scene(SCENE))


def test_two_runs_of_one_seed_agree_whatever_else_is_random(whole, tmp_path):
    torch.manual_seed(int.from_bytes(os.urandom(4), "little"))
    make_trainer(tmp_path).run()
    assert_same_bits(tmp_path, whole)
