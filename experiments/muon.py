"""Muon of PyTorch against the package's, on a processor without bfloat16 in float32.

    python experiments/muon.py --json results/muon.json

`torch.optim.Muon` orthogonalises updates in bfloat16, one matrix after the other. Both
train the same networks on the same data from the same seeds. The script writes the error
on test rollouts, in m and rad at 100 and 500 steps, and the time of an update of the
matrices.
"""

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from torch import Generator

from torchrl_nerd.configs import TrainConfig
from torchrl_nerd.data.simulate import simulate
from torchrl_nerd.dynamics import MujocoDynamics, NeRDDynamics
from torchrl_nerd.evaluation.results import write_results
from torchrl_nerd.evaluation.rollout_error import means_by_horizon, passive_errors
from torchrl_nerd.robots import load_scene, source_of
from torchrl_nerd.training.optimizers import make_adamw, split_parameters
from torchrl_nerd.training.trainer import Trainer

HORIZONS = (100, 500)  # control steps
TEST_SEED, TEST_ROLLOUTS = 7, 512


@dataclass
class Options:
    """What to train."""

    scene: str = "cartpole"
    networks: tuple[str, ...] = ("transformer-2x64", "mlp-4x64")
    seeds: tuple[int, ...] = (0, 1)
    trajectories: int = 4000
    steps: int = 2000
    """Updates on one-step targets; a tenth as many on rollouts follow."""
    json: Path | None = None
    """Write the results to this file."""


class TorchTrainer(Trainer):
    """A trainer whose matrices are updated by PyTorch's Muon."""

    def make_optimizers(self) -> dict[str, torch.optim.Optimizer]:
        """See `Trainer.make_optimizers`."""
        matrices, others = split_parameters(self.model.network)
        how = {"weight_decay": 0.0, "adjust_lr_fn": "original"}
        return {
            "muon": torch.optim.Muon(matrices, self.config.lr, **how),
            "adamw": make_adamw(others, self.config.adamw_lr, self.device),
        }


TRAINERS = {"float32": Trainer, "torch": TorchTrainer}


def train(options: Options, name: str, network: str, seed: int) -> dict[str, Any]:
    """Train one network and return its errors on test rollouts and the seconds taken."""
    scene = load_scene(options.scene)
    source = source_of(scene)
    data = simulate(scene, options.trajectories, 100, Generator().manual_seed(0))
    config = TrainConfig(
        network=network,
        steps=options.steps,
        rollout_steps=options.steps // 10,
        single_step_fraction=0.0,
        seed=seed,
        save_every=10**6,
        validate_every=10**6,
    )
    with tempfile.TemporaryDirectory() as folder:
        trainer = TRAINERS[name](
            scene, data, source, config, Path(folder), horizons=(2,), logger="csv"
        )
        model = trainer.run()
        found = {"optimizer": name, "network": network, "seed": seed}
        found["update_ms"] = update_ms(trainer)
    errors = passive_errors(
        source,
        NeRDDynamics(model),
        MujocoDynamics(scene),
        list(HORIZONS),
        num_trajectories=TEST_ROLLOUTS,
        seed=TEST_SEED,
    )
    return {**found, **means_by_horizon(errors)}


def update_ms(trainer: Trainer) -> float:
    """Milliseconds of processor time of an update of the matrices, the least of 30."""
    matrices, _ = split_parameters(trainer.model.network)
    for weight in matrices:
        weight.grad = torch.randn_like(weight)
    seconds = []
    for _ in range(30):
        began = time.process_time()
        trainer.optimizers["muon"].step()
        seconds.append(time.process_time() - began)
    return round(1e3 * min(seconds), 2)


def main() -> None:
    """Train every network from every seed with both optimizers."""
    options = tyro.cli(Options)
    torch.set_num_threads(1)
    results = []
    for seed in options.seeds:
        for network in options.networks:
            for name in TRAINERS:
                results.append(train(options, name, network, seed))
                print(results[-1], flush=True)
    if options.json is not None:
        write_results(options.json, results, list(options.seeds))


if __name__ == "__main__":
    main()
