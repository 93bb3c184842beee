"""A whole env in learned dynamics, eager and compiled, beside the same task in MuJoCo.

    python benchmarks/env_rate.py --tasks ant/run franka/reach --num-envs 512 2048

Control steps per second on all cores, with TorchRL's bookkeeping, rewards and resets; the
errors are those of `nerd bench`. Actions are drawn anew for every step, as those of a
policy that has not learned are. Each candidate is alone in a process of its own, as it is
where somebody uses it. They take turns. The first round begins with an empty cache of
torch, the others with a full one.
"""

import os
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import cycle
from multiprocessing import get_context
from pathlib import Path
from statistics import median
from typing import Any

import torch
import tyro

from torchrl_nerd import make_env
from torchrl_nerd.checkpoint import model_name, shipped_models
from torchrl_nerd.envs.base import SceneEnv
from torchrl_nerd.evaluation.bench.rates import Runner
from torchrl_nerd.evaluation.results import write_results
from torchrl_nerd.robots import TASKS, make_task
from torchrl_nerd.settings import expect_at_least

MUJOCO, ACTIONS, SAMPLES = "mujoco", 64, 7


@dataclass
class Options:
    """What to time."""

    tasks: tuple[str, ...] = ()
    """The first of every robot that has a shipped model where none is given."""
    num_envs: tuple[int, ...] = (512, 2048)
    rounds: int = 3
    """Processes of each candidate, at least two: the first has nothing compiled."""
    seed: int = 0
    json: Path | None = None
    """Write the results to this file."""


@dataclass(frozen=True)
class Candidate:
    """What is timed in a process of its own."""

    task: str
    dynamics: str
    compiled: bool
    num_envs: int


class Stepper:
    """Steps an env on and on, by random actions that come round again.

    Args:
        env: what to step.
        seed: of the actions.
    """

    def __init__(self, env: SceneEnv, seed: int) -> None:
        self.env, self.now = env, env.reset()
        torch.manual_seed(seed)
        self.actions = cycle([env.action_spec.rand() for _ in range(ACTIONS)])

    @torch.no_grad()
    def __call__(self, steps: int) -> None:
        """So many actions of every env, resets where episodes end."""
        for _ in range(steps):
            self.now.set("action", next(self.actions))
            _, self.now = self.env.step_and_maybe_reset(self.now)


def timed(one: Candidate, seed: int, cache: str) -> tuple[float, float]:
    """Seconds of the first steps, which compile, and control steps per second after.

    For a process of its own: from here on torch's ``cache`` is in that folder.
    """
    os.environ["TORCHINDUCTOR_CACHE_DIR"] = cache
    env = make_env(one.task, one.dynamics, one.num_envs, seed, compile=one.compiled)
    began = time.perf_counter()
    env.rollout(3, break_when_any_done=False)
    first = time.perf_counter() - began
    run = Stepper(env, seed)
    run(ACTIONS)  # resets of a few envs compile as well
    runner = Runner(run)
    rate = median(runner.steps_per_s() for _ in range(SAMPLES))
    return first, one.num_envs * rate


def candidates(task: str, batches: tuple[int, ...]) -> Iterator[Candidate]:
    """The network that ``"nerd"`` is there, the MLP of that robot, and MuJoCo."""
    for num_envs in batches:
        for name in learned(task):
            yield Candidate(task, name, False, num_envs)
            yield Candidate(task, name, True, num_envs)
        yield Candidate(task, MUJOCO, False, num_envs)


def learned(task: str) -> list[str]:
    """Shipped models of a task's robot that are timed."""
    name = model_name("nerd", make_task(task).scene)
    return [x for x in (name, f"{name}-mlp") if x in shipped_models()]


def measure(task: str, options: Options) -> list[dict[str, Any]]:
    """A row of each candidate, printed; rates are medians of the rounds."""
    ways = list(candidates(task, options.num_envs))
    spawn = get_context("spawn")
    with tempfile.TemporaryDirectory() as cache:
        with ProcessPoolExecutor(1, spawn, max_tasks_per_child=1) as alone:
            rounds = [
                [alone.submit(timed, way, options.seed, cache).result() for way in ways]
                for _ in range(options.rounds)
            ]
    table = []
    for way, *found in zip(ways, *rounds, strict=True):
        (cold, _), *warm = found
        row: dict[str, Any] = vars(way) | {"steps_per_s": median(x for _, x in found)}
        row |= {"cold_s": cold, "warm_s": median(x for x, _ in warm)}
        table.append(row)
        name = f"{way.dynamics}, compiled" if way.compiled else way.dynamics
        rate = f"{way.num_envs:>6} envs{row['steps_per_s']:>10,.0f} steps/s"
        times = f"first {row['cold_s']:6.1f} s, cached {row['warm_s']:5.1f} s"
        print(f"{task:<22}{name:<32}{rate}  {times}", flush=True)
    return table


def main(options: Options) -> None:
    """Print the rows of every task.

    Raises:
        ValueError: fewer than two rounds, or a batch of no envs.
    """
    expect_at_least(1, **{f"num_envs {x}": x for x in options.num_envs})
    expect_at_least(2, rounds=options.rounds)
    tasks = options.tasks
    if not tasks:
        of_robot = {make_task(x).scene.name: x for x in reversed(TASKS) if learned(x)}
        tasks = [x for x in TASKS if x in of_robot.values()]
    results = {}
    for task in tasks:
        results[task] = measure(task, options)
        if options.json is not None:
            write_results(options.json, {"tasks": results}, options.seed)


if __name__ == "__main__":
    main(tyro.cli(Options))
