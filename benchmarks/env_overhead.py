"""Where the time of a NeRDEnv step goes: TorchRL, task and bookkeeping, dynamics.

    python benchmarks/env_overhead.py --num-envs 512

Times `EnvBase.step` and, within the same calls, the env's own `_step`, the dynamics and,
where there is contact, kinematics and collision; prints median shares. TorchRL's overhead
is what lies outside `_step`.
"""

import time
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import torch
import tyro

from torchrl_nerd import NeRDEnv
from torchrl_nerd.configs import NO_PREDICTIONS
from torchrl_nerd.dynamics import Model
from torchrl_nerd.evaluation.results import write_results
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.modules.networks import NETWORKS
from torchrl_nerd.robots import make_task


@dataclass
class Options:
    """What to time."""

    task: str = "cartpole/swingup"
    num_envs: int = 512
    steps: int = 200
    threads: int | None = None
    json: Path | None = None
    """Write the results to this file."""


def timed(owner: object, name: str) -> list[float]:
    """Replace a method by one that also notes the seconds each call took."""
    inner, seconds = getattr(owner, name), []

    def method(*inputs: object) -> object:
        began = time.perf_counter()
        result = inner(*inputs)
        seconds.append(time.perf_counter() - began)
        return result

    setattr(owner, name, method)
    return seconds


def step_times(
    task: str, model: Model | str, num_envs: int, steps: int
) -> dict[str, float]:
    """Median seconds of a step and of its dynamics, and the shares of the rest."""
    env = NeRDEnv(task, model, num_envs=num_envs)
    dynamics, own = timed(env.dynamics, "step"), timed(env, "_step")
    contact = env.dynamics.model.scene_features.contact  # pyright: ignore
    evaluations = [
        timed(getattr(contact, name), "forward")
        for name in ("kinematics", "ground")
        if contact.terrain is not None
    ]
    td, whole = env.rand_action(env.reset()), timed(env, "step")
    contact_s = []
    for _ in range(steps):
        for seconds in evaluations:  # several a step where contacts are predicted
            seconds.clear()
        env.step(td)
        contact_s.append(sum(map(sum, evaluations)))
    calls = list(zip(dynamics, own, whole, strict=True))
    return {
        "step_s": median(whole),
        "dynamics_s": median(dynamics),
        "torchrl_share": median(1.0 - own / whole for _, own, whole in calls),
        "task_share": median((own - inner) / whole for inner, own, whole in calls),
        "contact_share": median(
            part / inner for part, inner in zip(contact_s, dynamics, strict=True)
        ),
    }


def main(options: Options) -> None:
    """Print a row for the shipped model and for each streaming preset."""
    if options.threads:
        torch.set_num_threads(options.threads)
    scene = make_task(options.task).scene
    models: dict[str, Model | str] = {"nerd": "nerd"}
    models |= {
        name: NeRD(scene, NO_PREDICTIONS, NETWORKS[name])
        for name in ("transformer-2x64", "transformer-4x128", "paper")
    }
    results = {}
    print(f"{options.task}, {options.num_envs} envs, {torch.get_num_threads()} threads")
    print(
        f"{'model':<10}{'step ms':>9}{'dynamics ms':>13}{'TorchRL':>9}{'task':>7}"
        f"{'steps/s':>10}  kinematics, collision (share of the dynamics)"
    )
    for name, model in models.items():
        row = step_times(options.task, model, options.num_envs, options.steps)
        results[name] = row
        rate = options.num_envs / row["step_s"]
        line = f"{name:<10}{1e3 * row['step_s']:>9.2f}{1e3 * row['dynamics_s']:>13.2f}"
        shares = f"{row['torchrl_share']:>9.1%}{row['task_share']:>7.1%}"
        print(f"{line}{shares}{rate:>10.0f}{row['contact_share']:>9.1%}")
    if options.json is not None:
        write_results(options.json, {"rows": options.num_envs, "models": results})


if __name__ == "__main__":
    main(tyro.cli(Options))
