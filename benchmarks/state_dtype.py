"""What states in float32 cost: error and rate of shipped models, beside float64.

    python benchmarks/state_dtype.py --json results/state_dtype.json

Errors are those of test starts against MuJoCo, of the whole horizon of each robot's
protocol; processor time of the eager step alone, in which both precisions take turns.
"""

import copy
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from scaling import two_in_turn

from torchrl_nerd.checkpoint import from_pretrained
from torchrl_nerd.dynamics import MujocoDynamics, NeRDDynamics
from torchrl_nerd.evaluation.bench.rates import Runner, mid_states, stepper
from torchrl_nerd.evaluation.results import write_results
from torchrl_nerd.evaluation.rollout_error import passive_errors
from torchrl_nerd.geometry.constants import cast_constants
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.robots import protocol_of


@dataclass
class Options:
    """What to measure."""

    models: tuple[str, ...] = ("cartpole", "double_pendulum", "ant", "franka", "cube")
    trajectories: int = 256
    num_envs: int = 512
    rounds: int = 7
    seed: int = 0
    json: Path | None = None
    """Write the results to this file."""


def measure(name: str, options: Options) -> dict[str, Any]:
    """Errors by quantity, and microseconds of a step of one env."""
    found: dict[str, Any] = {}
    model = from_pretrained(name)
    assert isinstance(model, NeRD)
    protocol = protocol_of(model.scene)
    case, source = next(iter(protocol.cases.items()))
    horizon, is_random = max(protocol.horizons), case in protocol.random_actions
    state, runners = mid_states(model.scene, options.num_envs, options.seed), []
    for dtype in (torch.float64, torch.float32):
        dynamics = NeRDDynamics(cast_constants(copy.deepcopy(model), dtype))
        given = source, dynamics, MujocoDynamics(model.scene), [horizon]
        errors = passive_errors(
            *given, options.trajectories, options.seed, random_actions=is_random
        )[horizon]
        kind = str(dtype).removeprefix("torch.")
        found[kind] = {quantity: x.mean for quantity, x in errors.items()}
        runners.append(Runner(stepper(dynamics, state), time.process_time))
    fine, coarse = runners
    rates = two_in_turn(fine, coarse, options.rounds)
    for kind, rate in zip(("float64", "float32"), rates, strict=False):
        found[f"{kind}_us"] = 1e6 / (options.num_envs * rate)
    return {"case": case, "steps": horizon, **found}


def main(options: Options) -> dict[str, Any]:
    """Measure every model, and write the results down."""
    results = {name: measure(name, options) for name in options.models}
    for name, row in results.items():
        print(name, row)
    if options.json is not None:
        write_results(options.json, results, options.seed)
    return results


if __name__ == "__main__":
    torch.set_grad_enabled(False)
    main(tyro.cli(Options))
