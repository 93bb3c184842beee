"""The loss of one step with positions weighed as speeds, and with all errors alike.

    python experiments/loss_weights.py ant --json results/loss_weights_ant.json

Equal networks of `nerd train` learn a robot from the same data and batches, by the same
number of updates. One learns with the weights of `StateDelta.error_weights`, the other
with 1 for all: a standard deviation of a position's residual, which moves the robot by a
tenth of what one of velocity does, then costs as much. Errors are those of the robot's
protocol: passive or driven test rollouts, means over its horizons.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from products import errors_of, settings
from symmetric_layers import trained, write
from tensordict import TensorDict

from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.training.trainer import Trainer

TEST_ROLLOUTS = 256


class EqualWeights(Trainer):
    """Training in which an error in standard deviations counts alike everywhere."""

    def _build(self, data: TensorDict, init_from: NeRD | None) -> None:
        super()._build(data, init_from)
        self.weights = torch.ones_like(self.weights)


TRAINERS = {"alike": EqualWeights, "as speeds": Trainer}


@dataclass
class Options:
    """What to train."""

    scene: tyro.conf.Positional[str]
    network: str = "mlp-4x128-products"
    seeds: tuple[int, ...] = (0,)
    trajectories: int = 5000
    steps: int = 2500
    """Updates on single steps; a tenth as many on rollouts follow."""
    json: Path | None = None
    """Write the results to this file."""


def main(options: Options) -> None:
    """Train with both losses in turns and print, or write, what came of it."""
    torch.set_num_threads(1)
    results: list[dict[str, Any]] = []
    for seed in options.seeds:
        for positions, trainer in TRAINERS.items():
            scene, config, horizons = settings(options, options.network, seed)
            how = options.trajectories, horizons, trainer
            model, about = trained(scene, config, *how)
            row = {"positions": positions, "network": options.network, "seed": seed}
            results.append(row | about | errors_of(model))
            print(results[-1], flush=True)
    write(options, results, TEST_ROLLOUTS)


if __name__ == "__main__":
    main(tyro.cli(Options))
