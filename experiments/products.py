"""Networks with and without products of features: errors at equal training.

    python experiments/products.py franka --json results/products_franka.json

Two MLPs of `nerd train` learn a robot from the same data, batches and number of updates.
One of them also multiplies features, see `torchrl_nerd.modules.products`. Errors are those
of the robot's protocol: passive or driven test rollouts, means over its horizons.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
import tyro
from symmetric_layers import TEST_SEED, trained, write

from torchrl_nerd.configs import TrainConfig
from torchrl_nerd.dynamics import MujocoDynamics, NeRDDynamics
from torchrl_nerd.evaluation.rollout_error import means_by_horizon, passive_errors
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.robots import load_scene, preset_of, protocol_of
from torchrl_nerd.scenes import Scene

TEST_ROLLOUTS = 256


@dataclass
class Options:
    """What to train."""

    scene: tyro.conf.Positional[str]
    network: str = "mlp-4x128"  # alone, and with products
    seeds: tuple[int, ...] = (0,)
    trajectories: int = 5000
    steps: int = 2500
    """Updates on single steps; a tenth as many on rollouts follow."""
    json: Path | None = None
    """Write the results to this file."""


def settings(
    options: Any, network: str, seed: int
) -> tuple[Scene, TrainConfig, tuple[int, ...]]:
    """The robot, how it is learned, and the horizons of its protocol."""
    scene, preset = load_scene(options.scene), preset_of(options.scene)
    config = replace(
        preset.train,
        network=network,
        step=None,
        steps=options.steps,
        rollout_steps=options.steps // 10,
        single_step_fraction=1.0,
        bf16_fraction=0.0,
        seed=seed,
    )
    return scene, config, protocol_of(scene).horizons


def errors_of(model: NeRD) -> dict[str, float]:
    """Mean errors on the test rollouts of a robot's protocol, by case and horizon."""
    protocol, found = protocol_of(model.scene), {}
    both = NeRDDynamics(model), MujocoDynamics(model.scene)
    for case, of_case in protocol.cases.items():
        how = list(protocol.horizons), TEST_ROLLOUTS, TEST_SEED
        is_driven = case in protocol.random_actions
        errors = passive_errors(of_case, *both, *how, random_actions=is_driven)
        found |= {f"{case}_{key}": x for key, x in means_by_horizon(errors).items()}
    return found


def train(options: Options, network: str, seed: int) -> dict[str, Any]:
    """Train one network and return its errors on test rollouts and the time taken."""
    scene, config, horizons = settings(options, network, seed)
    model, about = trained(scene, config, options.trajectories, horizons)
    row = {"network": network, "seed": seed, **about}
    return row | errors_of(model)


def main(options: Options) -> None:
    """Train all networks in turns and print, or write, what came of it."""
    torch.set_num_threads(1)
    results = []
    for seed in options.seeds:
        for network in (options.network, f"{options.network}-products"):
            results.append(train(options, network, seed))
            print(results[-1], flush=True)
    write(options, results, TEST_ROLLOUTS)


if __name__ == "__main__":
    main(tyro.cli(Options))
