"""A training that was killed at any moment ends in the bits of one that was not."""

import os
import shutil
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import pytest
import torch
from dynamics_helpers import random_model
from safetensors.torch import load_file
from torch import Generator

from torchrl_nerd.configs import TrainConfig
from torchrl_nerd.data.generate import simulate
from torchrl_nerd.files import read_json
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.robots import load_scene, make_task
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
PHASES = {"one-step": 6, "save": 8, "rollout": 18}
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

KILLED = """
import os, signal, sys
from functools import reduce
from pathlib import Path
import torch
from torch import Generator
from torchrl_nerd.data.generate import simulate
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


def make_trainer(folder: Path, start: NeRD | None = None) -> Trainer:
    scene = load_scene(SCENE)
    data = simulate(scene, 60, 10, Generator().manual_seed(1))
    task, how = make_task(TASK), {"horizons": (2, 4), "quiet": True}
    return Trainer(scene, data, task, CONFIG, folder, init_from=start, **how)


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """The run that nothing interrupted."""
    folder = tmp_path_factory.mktemp("whole")
    make_trainer(folder).run()
    return folder


@pytest.fixture(scope="module")
def killed(tmp_path_factory) -> Path:
    """Folders ``function-call`` of runs that ended at that call."""
    root = tmp_path_factory.mktemp("killed")
    code = KILLED.format(
        threads=torch.get_num_threads(),
        moments=MOMENTS,
        config=asdict(CONFIG),
        scene=SCENE,
        task=TASK,
    )
    subprocess.run([sys.executable, "-c", code, str(root)], check=True)
    return root


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


@pytest.mark.parametrize("stop", PHASES.values(), ids=PHASES)
def test_a_stopped_run_goes_on_to_the_same_bits(stop, whole, tmp_path):
    make_trainer(tmp_path).run(until=stop)
    resumed = make_trainer(tmp_path)
    assert resumed.step == stop // CONFIG.save_every * CONFIG.save_every
    resumed.run()
    assert_same_bits(tmp_path, whole)


def test_a_run_with_a_start_goes_on_to_the_same_bits(tmp_path, generator):
    start = random_model(load_scene(SCENE), generator, CONFIG.network)
    for folder in ("whole", "stopped"):
        until = PHASES["rollout"] if folder == "stopped" else None
        make_trainer(tmp_path / folder, start).run(until)
    resumed = make_trainer(tmp_path / "stopped", start)
    assert 0 < resumed.step < CONFIG.total_steps
    resumed.run()
    assert_same_bits(tmp_path / "stopped", tmp_path / "whole")
    other = random_model(load_scene(SCENE), generator, CONFIG.network)
    for another in (other, None):
        with pytest.raises(ValueError, match="stopped holds a run with init_from"):
            make_trainer(tmp_path / "stopped", another)


@pytest.mark.parametrize(("name", "call"), MOMENTS, ids=lambda value: str(value))
def test_a_killed_run_goes_on_to_the_same_bits(name, call, killed, whole, tmp_path):
    folder = shutil.copytree(killed / f"{name}-{call}", tmp_path / "killed")
    resumed = make_trainer(folder)
    assert resumed.step % CONFIG.save_every == 0
    uninterrupted = make_trainer(tmp_path / "whole")
    if resumed.step:
        uninterrupted.run(until=resumed.step)
    assert min(resumed.best, 1e300) == min(uninterrupted.best, 1e300)
    resumed.run()
    assert_same_bits(folder, whole)
    assert not list(folder.rglob(".*.tmp"))


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


def test_two_runs_of_one_seed_agree_whatever_else_is_random(whole, tmp_path):
    torch.manual_seed(int.from_bytes(os.urandom(4), "little"))
    make_trainer(tmp_path).run()
    assert_same_bits(tmp_path, whole)
