"""Share of a NeRDEnv step that is not dynamics: TorchRL, task, bookkeeping.

    python benchmarks/env_overhead.py --rows 512

Times `EnvBase.step` and, within the same calls, the dynamics; prints the median shares.
"""

import platform
import time
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import torch
import tyro

from torchrl_nerd import make_env
from torchrl_nerd.dynamics import NeRDDynamics
from torchrl_nerd.files import write_json
from torchrl_nerd.modules.nerd import NETWORKS, NeRD


@dataclass
class Options:
    """What to time."""

    task: str = "cartpole/swingup"
    rows: int = 512
    steps: int = 200
    threads: int | None = None
    json: Path | None = None
    """Write the figures to this file."""


def step_times(
    task: str, model: NeRD | None, rows: int, steps: int
) -> dict[str, float]:
    """Median seconds of a whole step and of its dynamics, and their overhead's share."""
    env = make_env(task, num_envs=rows)
    if model is not None:
        env.dynamics = NeRDDynamics(model)
    inner, spent = env.dynamics.step, []

    def timed(*inputs):  # noqa: ANN002, ANN202
        began = time.perf_counter()
        result = inner(*inputs)
        spent.append(time.perf_counter() - began)
        return result

    setattr(env.dynamics, "step", timed)  # noqa: B010
    td = env.rand_action(env.reset())
    whole = []
    for _ in range(steps):
        began = time.perf_counter()
        env.step(td)
        whole.append(time.perf_counter() - began)
    share = median(1.0 - a / b for a, b in zip(spent, whole, strict=True))
    return {"step_s": median(whole), "dynamics_s": median(spent), "overhead": share}


def main(options: Options) -> None:
    """Print a row for the shipped model and for each streaming preset."""
    if options.threads:
        torch.set_num_threads(options.threads)
    scene = make_env(options.task).scene
    models = {"shipped": None}
    models |= {name: NeRD(scene, NETWORKS[name]) for name in ("tiny", "small", "paper")}
    figures = {}
    print(f"{options.task}, {options.rows} rows, {torch.get_num_threads()} threads")
    print(
        f"{'model':<10}{'step ms':>9}{'dynamics ms':>13}{'overhead':>10}{'steps/s':>10}"
    )
    for name, model in models.items():
        row = step_times(options.task, model, options.rows, options.steps)
        figures[name] = row
        rate = options.rows / row["step_s"]
        line = f"{name:<10}{1e3 * row['step_s']:>9.2f}{1e3 * row['dynamics_s']:>13.2f}"
        print(f"{line}{row['overhead']:>10.1%}{rate:>10.0f}")
    if options.json is not None:
        machine = {"processor": platform.machine(), "threads": torch.get_num_threads()}
        write_json(options.json, {"rows": options.rows, **machine, "models": figures})


if __name__ == "__main__":
    main(tyro.cli(Options))
