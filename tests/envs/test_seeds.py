"""Same seed, same bits; another seed, other numbers; global generators left alone."""

import functools
import hashlib
import os
import random
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
import torch
from dynamics_helpers import (
    EnvMaker,
    act_all,
    each_dynamics,
    random_actions,
    random_model,
    row_uniforms,
    unequal_keys,
)
from torch import Generator, Tensor
from torchrl.collectors import MultiSyncCollector
from torchrl.envs import ParallelEnv, SerialEnv

from torchrl_nerd import GroundTruthEnv, NeRDEnv, load_scene, make_env
from torchrl_nerd.checkpoint import make_card, save_checkpoint
from torchrl_nerd.robots import ROBOTS, TASKS, make_task

ROWS, STEPS = 4, 8
TASK = "cartpole/swingup"


def life(env, generator: Generator) -> Tensor:
    """Steps and resets of an env whose episodes are short, ``[rows, steps]``."""
    actions, state, states = random_actions(env, STEPS, generator), env.reset(), []
    for action in actions:
        record, state = env.step_and_maybe_reset(state.set("action", action))
        states.append(record)
    return torch.stack(states, 1)


@each_dynamics
def test_same_seed_same_bits_and_other_seed_other_starts(
    task_id, dynamics, generator, seed
):
    make = EnvMaker(task_id, dynamics, generator, horizon=3)
    copies = [life(make(ROWS, seed), Generator().manual_seed(1)) for _ in range(2)]
    assert not unequal_keys(*copies)
    other = life(make(ROWS, seed ^ 1), Generator().manual_seed(1))
    assert (other["qpos"][:, 0] != copies[0]["qpos"][:, 0]).any(-1).all()


@pytest.mark.parametrize("dynamics", ["streaming", "mujoco"])
def test_setting_the_seed_begins_again(task_id, dynamics, generator, seed):
    make = EnvMaker(task_id, dynamics, generator, horizon=3)
    env = make(ROWS, 0)
    life(env, generator)
    env.set_seed(seed)
    again = life(env, Generator().manual_seed(1))
    assert not unequal_keys(again, life(make(ROWS, seed), Generator().manual_seed(1)))


def test_a_seed_is_drawn_where_none_is_given_and_workers_differ(generator):
    serial = SerialEnv(3, functools.partial(GroundTruthEnv, TASK, num_envs=ROWS))
    starts = serial.reset()["qpos"].flatten(0, 1)
    assert len(starts.unique(dim=0)) == 3 * ROWS
    serial.set_seed(7)
    seeded = serial.reset()["qpos"]
    assert len(seeded.flatten(0, 1).unique(dim=0)) == 3 * ROWS
    serial.set_seed(7)
    assert torch.equal(serial.reset()["qpos"], seeded)
    makers = [make_env, NeRDEnv, GroundTruthEnv]
    assert len({make(TASK).seed for make in makers + makers}) == 6
    assert all(make(TASK, seed=3).seed == 3 for make in makers)
    env = make_env(TASK, seed=3)
    env.set_seed()
    assert env.seed != 3


@pytest.mark.slow
def test_workers_in_processes_begin_at_starts_of_their_own():
    make = functools.partial(GroundTruthEnv, TASK, num_envs=ROWS)
    parallel = ParallelEnv(3, make)
    collector = MultiSyncCollector([make] * 3, frames_per_batch=6 * ROWS)
    try:
        starts = parallel.reset()["qpos"].flatten(0, 1)
        assert len(starts.unique(dim=0)) == 3 * ROWS
        first = next(iter(collector))["qpos"].flatten(0, 1)[:, 0]
        assert len(first.unique(dim=0)) == 3 * ROWS
    finally:
        parallel.close()
        collector.shutdown()


def test_any_seed_that_torchrl_hands_on_is_taken(seed):
    env = GroundTruthEnv(TASK)
    env.set_seed(2**32 - 2)  # the largest that torchrl's seed_generator gives
    for _ in range(16):
        seed = env.set_seed(seed)


def test_episodes_rows_and_seeds_share_no_numbers(task_id, seed):
    starts = []
    for step in range(3):
        env = GroundTruthEnv(task_id, num_envs=ROWS, seed=(seed + step) % 2**31)
        for _ in range(2):
            start = env.reset()
            starts.append(torch.cat((start["qpos"], start["qvel"]), -1))
    rows = torch.cat(starts)
    assert len(rows.unique(dim=0)) == len(rows) == 6 * ROWS


def test_a_row_draws_the_same_in_any_company(task_id, seed):
    few, many = (GroundTruthEnv(task_id, num_envs=n, seed=seed) for n in (3, 7))
    for _ in range(2):
        a, b = few.reset(), many.reset()
        assert torch.equal(a["qpos"], b["qpos"][:3])
        assert torch.equal(a["qvel"], b["qvel"][:3])


def test_uniform_numbers_are_uniform_and_uncorrelated(seed):
    rows, episodes, count = 128, 16, 8
    u = torch.stack(
        [row_uniforms(seed, torch.full((rows,), e), count) for e in range(episodes)]
    )
    assert u.min() >= 0.0 and u.max() < 1.0
    ordered = u.flatten().sort().values
    grid = torch.arange(len(ordered)) / len(ordered)
    assert (ordered - grid).abs().max() < 3.5 / len(ordered) ** 0.5  # one in 10^10
    for dim in range(3):
        a, b = u.narrow(dim, 0, u.shape[dim] - 1), u.narrow(dim, 1, u.shape[dim] - 1)
        correlation = 12.0 * ((a - 0.5) * (b - 0.5)).mean()
        assert correlation.abs() < 7.0 / a.numel() ** 0.5


@each_dynamics
def test_the_global_generators_are_left_alone(task_id, dynamics, generator, tmp_path):
    make = EnvMaker(task_id, dynamics, generator, horizon=2)
    if make.model is not None:
        save_checkpoint(make.model, tmp_path, make_card(make.model))

    def states() -> tuple:
        return torch.get_rng_state().tolist(), random.getstate(), np.random.get_state()

    before = states()
    env = make(ROWS)
    env.set_seed(1)
    life(env, generator)
    if make.model is not None:
        NeRDEnv(task_id, tmp_path)
    after = states()
    assert after[:2] == before[:2]
    assert (after[2][1] == before[2][1]).all() and after[2][2] == before[2][2]


FIRST = [next(iter(robot.tasks)) for robot in ROBOTS.values()][::2]
"""One task of every second robot; all tasks are slow."""


def fingerprint(folder: Path, seed: int, tasks: Iterable[str]) -> str:
    """Hash of a few steps of these tasks, in learned and in MuJoCo."""
    digest = hashlib.sha256()
    for task_id in tasks:
        scene = make_task(task_id).scene.name
        for dynamics in (folder / scene, "mujoco"):
            env = make_env(task_id, dynamics, ROWS, seed)
            env.reset()
            path = act_all(env, random_actions(env, 4, Generator().manual_seed(seed)))
            for key in ("qpos", "qvel", "observation", "reward"):
                digest.update(path[key].contiguous().numpy().tobytes())
    return digest.hexdigest()


@pytest.mark.parametrize(
    "tasks", [FIRST, pytest.param(list(TASKS), marks=pytest.mark.slow)], ids=len
)
def test_another_process_gets_the_same_bits(tasks, tmp_path, generator, seed):
    for scene in {make_task(task).scene.name for task in tasks}:
        model = random_model(load_scene(scene), generator)
        save_checkpoint(model, tmp_path / scene, make_card(model))
    code = (
        "import sys; from pathlib import Path; from test_seeds import fingerprint;"
        "print(fingerprint(Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3:]))"
    )
    paths = [Path(__file__).parent, Path(__file__).parents[1]]
    result = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path), str(seed), *tasks],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(map(str, paths))},
        capture_output=True,
        text=True,
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout.split()[-1] == fingerprint(tmp_path, seed, tasks)
