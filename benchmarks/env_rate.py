"""A whole env in learned dynamics, eager and compiled, beside the same task in MuJoCo.

    python benchmarks/env_rate.py --tasks ant/run franka/reach --num-envs 512 2048

Control steps per second on all cores, with TorchRL's bookkeeping, rewards and resets; the
errors are those of `nerd bench`. All candidates of a batch take turns. Actions are drawn
anew for every step, as those of a policy that has not learned are. Seconds of the first
compiled step, reset included, are those of new processes: a cold one, and a warm one that
finds its code in torch's cache.
"""

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import cycle
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

FIRST_STEP = """
import sys, time
from torchrl_nerd import make_env
task, dynamics, num_envs = sys.argv[1:]
env = make_env(task, dynamics, num_envs=int(num_envs), seed=0, compile=True)
began = time.perf_counter()
env.rollout(3)
print(time.perf_counter() - began)
"""
MUJOCO, ACTIONS = "mujoco", 64


@dataclass
class Options:
    """What to time."""

    tasks: tuple[str, ...] = ()
    """The first of every robot that has a shipped model where none is given."""
    num_envs: tuple[int, ...] = (512, 2048)
    rounds: int = 7
    seed: int = 0
    json: Path | None = None
    """Write the results to this file."""


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


def learned(task: str) -> list[str]:
    """The network that ``"nerd"`` is there, and the MLP of that robot."""
    name = model_name("nerd", make_task(task).scene)
    return [x for x in (name, f"{name}-mlp") if x in shipped_models()]


def rates(task: str, num_envs: int, options: Options) -> Iterator[dict[str, Any]]:
    """Control steps per second of every candidate with one batch: medians of rounds."""
    ways = [(x, compiled) for x in learned(task) for compiled in (False, True)]
    ways.append((MUJOCO, False))
    runners = []
    for dynamics, compiled in ways:
        env = make_env(task, dynamics, num_envs, options.seed, compile=compiled)
        run = Stepper(env, options.seed)
        run(8)  # compiles: a step, a reset, and both once more where sizes vary
        runners.append(Runner(run))
    samples = [[x.steps_per_s() for x in runners] for _ in range(options.rounds)]
    for (name, compiled), *found in zip(ways, *samples, strict=True):
        rate = num_envs * median(found)
        asked = {"dynamics": name, "compiled": compiled, "num_envs": num_envs}
        yield asked | {"steps_per_s": rate}


def first_steps(task: str, dynamics: str, num_envs: int, cache: str) -> dict[str, Any]:
    """Seconds of the first compiled step: of all envs, with a cache empty and filled."""
    found: dict[str, Any] = {"dynamics": dynamics}
    for name in ("cold_s", "warm_s"):
        done = subprocess.run(
            [sys.executable, "-c", FIRST_STEP, task, dynamics, str(num_envs)],
            env={**os.environ, "TORCHINDUCTOR_CACHE_DIR": cache},
            stdout=subprocess.PIPE,
            check=True,
        )
        found[name] = float(done.stdout)
    return found


def measure(task: str, options: Options) -> dict[str, Any]:
    """All of one task, printed; what was compiled for a first step serves the others."""
    first, table = [], []
    for dynamics in learned(task):
        with tempfile.TemporaryDirectory() as cache:
            row = first_steps(task, dynamics, options.num_envs[0], cache)
        first.append(row)
        times = f"cold {row['cold_s']:.1f} s, with torch's cache {row['warm_s']:.1f} s"
        print(f"{task:<24}{dynamics:<22}first compiled step: {times}", flush=True)
    for num_envs in options.num_envs:
        for row in rates(task, num_envs, options):
            table.append(row)
            way = "compiled" if row["compiled"] else ""
            rate = f"{num_envs:>6} envs{row['steps_per_s']:>10,.0f} steps/s"
            print(f"{task:<24}{row['dynamics']:<22}{way:<9}{rate}", flush=True)
    return {"first_steps": first, "rates": table}


def main(options: Options) -> None:
    """Print the rows of every task.

    Raises:
        ValueError: no rounds, or a batch of no envs.
    """
    batches = {f"num_envs {x}": x for x in options.num_envs}
    expect_at_least(1, rounds=options.rounds, **batches)
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
