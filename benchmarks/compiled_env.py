"""A whole env in learned dynamics, eager and compiled, beside the same in MuJoCo.

    python benchmarks/compiled_env.py --tasks ant/run franka/reach --num-envs 512

They take turns on one thread; processor time of an action of one env, TorchRL's
bookkeeping and resets included. Actions are random and held, from the starts of episodes
on, so robots that fall spend some steps in the air. Seconds of the first compiled step,
reset included, are those of new processes: a cold one, and a warm one that finds its code
in torch's cache.
"""

import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from scaling import two_in_turn

from torchrl_nerd import make_env
from torchrl_nerd.checkpoint import model_name, shipped_models
from torchrl_nerd.envs.base import SceneEnv
from torchrl_nerd.evaluation.bench.rates import Runner
from torchrl_nerd.evaluation.results import write_results
from torchrl_nerd.robots import TASKS, make_task

FIRST_STEP = """
import sys, time
from torchrl_nerd import make_env
env = make_env(sys.argv[1], num_envs=int(sys.argv[2]), seed=0, compile=True)
began = time.perf_counter()
env.rollout(3)
print(time.perf_counter() - began)
"""


@dataclass
class Options:
    """What to time."""

    tasks: tuple[str, ...] = ()
    """All whose robot has a shipped model where none is given."""
    num_envs: int = 512
    rounds: int = 7
    seed: int = 0
    json: Path | None = None
    """Write the results to this file."""


class Stepper:
    """Steps an env on and on, by an action that is held.

    Args:
        env: what to step.
        seed: of the action.
    """

    def __init__(self, env: SceneEnv, seed: int) -> None:
        self.env, self.now = env, env.reset()
        torch.manual_seed(seed)
        self.action = env.action_spec.rand()

    @torch.no_grad()
    def __call__(self, steps: int) -> None:
        """So many actions of every env, resets where episodes end."""
        for _ in range(steps):
            self.now.set("action", self.action)
            _, self.now = self.env.step_and_maybe_reset(self.now)


def compare(task: str, num_envs: int, rounds: int, seed: int) -> dict[str, float]:
    """Microseconds of an action of one env in each, and what compiling brings."""
    envs = (make_env(task, x, num_envs, seed) for x in ("nerd", "nerd", "mujoco"))
    eager, compiled, mujoco = (Stepper(env, seed) for env in envs)
    compiled.env.compile()
    compiled(2)
    one, other, third = (
        Runner(x, time.process_time) for x in (compiled, eager, mujoco)
    )
    fast, slow, ratio = two_in_turn(one, other, rounds)
    true, _, _ = two_in_turn(third, other, rounds)
    eager_us, compiled_us, mujoco_us = (
        1e6 / (num_envs * x) for x in (slow, fast, true)
    )
    return {
        "eager_us": eager_us,
        "compiled_us": compiled_us,
        "mujoco_us": mujoco_us,
        "ratio": ratio,
    }


def first_steps(task: str, num_envs: int, cache: str) -> dict[str, float]:
    """Seconds of the first compiled step: of all envs, with a cache empty and filled."""
    found = {}
    for name in ("cold_s", "warm_s"):
        done = subprocess.run(
            [sys.executable, "-c", FIRST_STEP, task, str(num_envs)],
            env={**os.environ, "TORCHINDUCTOR_CACHE_DIR": cache},
            stdout=subprocess.PIPE,
            check=True,
        )
        found[name] = float(done.stdout)
    return found


def measure(task: str, num_envs: int, rounds: int, seed: int) -> dict[str, float]:
    """All of one task; what was compiled for the first step serves the others."""
    with tempfile.TemporaryDirectory() as cache:
        found = first_steps(task, num_envs, cache)
        os.environ["TORCHINDUCTOR_CACHE_DIR"] = cache
        return found | compare(task, num_envs, rounds, seed)


def main(options: Options) -> None:
    """Print a row for every task."""
    torch.set_num_threads(1)
    os.environ["NERD_THREADS"] = "1"
    shipped = shipped_models()
    learned = {x: model_name("nerd", make_task(x).scene) for x in TASKS}
    tasks = options.tasks or [x for x in TASKS if learned[x] in shipped]
    print(f"{options.num_envs} envs, one thread, us of an action of one env")
    columns = f"{'task':<30}{'eager':>8}{'compiled':>10}{'MuJoCo':>8}{'ratio':>7}"
    print(f"{columns}{'cold':>8}{'warm, s':>9}")
    results = {}
    for task in tasks:
        row = measure(task, options.num_envs, options.rounds, options.seed)
        results[task] = row
        rates = (
            f"{row['eager_us']:>8.1f}{row['compiled_us']:>10.1f}"
            f"{row['mujoco_us']:>8.1f}{row['ratio']:>7.2f}"
        )
        print(
            f"{task:<30}{rates}{row['cold_s']:>8.1f}{row['warm_s']:>9.1f}", flush=True
        )
        if options.json is not None:
            found = {"rows": options.num_envs, "tasks": results}
            write_results(options.json, found, options.seed)


if __name__ == "__main__":
    main(tyro.cli(Options))
