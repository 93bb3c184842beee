"""What compiling brings to a whole env: steps with their resets, eager and compiled.

    python benchmarks/compiled_env.py --tasks ant/run franka/reach --rows 512

Both take turns on one thread; processor time of an action of one row, TorchRL's
bookkeeping included, and of the first compiled step, which compiles. Actions are random
and held, from the starts of episodes on, so robots that fall spend some steps in the air.
"""

import time
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from scaling import two_in_turn

from torchrl_nerd import NeRDEnv
from torchrl_nerd.checkpoint import shipped_models
from torchrl_nerd.envs.base import SceneEnv
from torchrl_nerd.evaluation.bench.rates import Runner
from torchrl_nerd.evaluation.results import write_results
from torchrl_nerd.robots import TASKS, make_task


@dataclass
class Options:
    """What to time."""

    tasks: tuple[str, ...] = ()
    """All whose robot has a shipped model where none is given."""
    rows: int = 512
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
        """So many actions of every row, resets where episodes end."""
        for _ in range(steps):
            self.now.set("action", self.action)
            _, self.now = self.env.step_and_maybe_reset(self.now)


def compare(task: str, rows: int, rounds: int, seed: int) -> dict[str, float]:
    """Microseconds of an action of one row, their ratio, and seconds to compile."""
    eager = Stepper(NeRDEnv(task, num_envs=rows, seed=seed), seed)
    compiled = Stepper(NeRDEnv(task, num_envs=rows, seed=seed).compile(), seed)
    began = time.perf_counter()
    compiled(2)
    seconds = time.perf_counter() - began
    one, other = (Runner(x, time.process_time) for x in (compiled, eager))
    fast, slow, ratio = two_in_turn(one, other, rounds)
    return {
        "eager_us": 1e6 / (rows * slow),
        "compiled_us": 1e6 / (rows * fast),
        "ratio": ratio,
        "compile_s": seconds,
    }


def main(options: Options) -> None:
    """Print a row for every task."""
    torch.set_num_threads(1)
    shipped = shipped_models()
    tasks = options.tasks or [t for t in TASKS if make_task(t).scene.name in shipped]
    print(f"{options.rows} rows, one thread, us of an action of one row")
    print(f"{'task':<30}{'eager':>8}{'compiled':>10}{'ratio':>7}{'compiling, s':>14}")
    results = {}
    for task in tasks:
        row = compare(task, options.rows, options.rounds, options.seed)
        results[task] = row
        rates = (
            f"{row['eager_us']:>8.1f}{row['compiled_us']:>10.1f}{row['ratio']:>7.2f}"
        )
        print(f"{task:<30}{rates}{row['compile_s']:>14.1f}", flush=True)
    if options.json is not None:
        write_results(
            options.json, {"rows": options.rows, "tasks": results}, options.seed
        )


if __name__ == "__main__":
    main(tyro.cli(Options))
