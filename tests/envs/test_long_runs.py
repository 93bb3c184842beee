"""Long runs cost no more memory than short ones, and leave no process behind."""

import functools
import multiprocessing
import resource
from concurrent.futures import ProcessPoolExecutor
from math import ceil
from multiprocessing import resource_tracker
from pathlib import Path

import pytest
import torch
from dynamics_helpers import EnvMaker, random_actions
from tensordict import TensorDict
from torchrl.envs import ParallelEnv

from torchrl_nerd.robots import make_task

TASK = "cartpole/swingup"
ROWS, HORIZON = 4, 5
WARM_UP = 100  # steps until caches and pools are as large as they get
GROWTH = 2 * 2**20  # bytes, of all the steps
MANY = 1024
DAY = ceil(
    86_400 / (MANY * make_task(TASK).scene.control_step)
)  # steps of so many rows

each_length = pytest.mark.parametrize(
    ("rows", "steps"),
    [
        (ROWS, 50),
        pytest.param(ROWS, 5_000, marks=pytest.mark.slow),
        pytest.param(MANY, DAY, marks=pytest.mark.slow),
    ],
)


def resident() -> int:
    """Memory of this process, bytes."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize()


def children() -> set[str]:
    """Process numbers of all children of this process, ended ones included."""
    lists = Path("/proc/self/task").glob("*/children")
    return {number for path in lists for number in path.read_text().split()}


def sizes(dynamics: str, rows: int, steps: int, seed: int) -> list[int]:
    """Memory after each step of an env, once it has warmed up."""
    generator = torch.Generator().manual_seed(seed)
    env = EnvMaker(TASK, dynamics, generator, HORIZON)(rows)
    actions = random_actions(env, 64, generator)
    now, found = env.reset(), []
    for step in range(WARM_UP + steps):
        now["action"] = actions[step % len(actions)]
        _, now = env.step_and_maybe_reset(now)
        found.append(resident())
    return found[WARM_UP:]


@each_length
@pytest.mark.slow
@pytest.mark.parametrize("dynamics", ["streaming", "mujoco"])
def test_memory_does_not_grow_with_steps_and_resets(dynamics, rows, steps, seed):
    # in a process of its own: what other tests left behind is reused, or not, at any time
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as alone:
        found = alone.submit(sizes, dynamics, rows, steps, seed).result()
    # the lowest of each half: an allocator fills up and is trimmed every few thousand steps
    first, last = min(found[: steps // 2]), min(found[steps // 2 :])
    assert last - first < GROWTH, f"{2 * (last - first) / steps:.0f} bytes a step"


@pytest.mark.slow
@pytest.mark.parametrize("resets", [5, 3000])
def test_parallel_envs_reset_and_leave_no_process(resets, generator):
    resource_tracker.ensure_running()  # Python's own, which stays
    before = children()
    makers = [EnvMaker(TASK, d, generator, HORIZON) for d in ("streaming", "mujoco")]
    parallel = ParallelEnv(2, [functools.partial(make, ROWS) for make in makers])
    try:
        shape = (2, ROWS, 1)
        for _ in range(resets):
            mask = torch.rand(shape, generator=generator) < 0.5
            mask[:, 0] = True
            state = parallel.reset(TensorDict({"_reset": mask}, [2, ROWS]))
            assert state["observation"].isfinite().all()
        workers = children() - before
        assert len(workers) >= 2
    finally:
        parallel.close(raise_if_closed=False)
    assert not children() & workers
