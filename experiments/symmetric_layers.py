"""Networks with and without the mirrors of their robot: errors at equal training.

    python experiments/symmetric_layers.py --json results/symmetric_layers.json

MLPs of `nerd train` learn the Ant from the same data, batches and number of updates. All
are shown symmetric copies of the data. Those with ``symmetries`` have the mirrors built in,
see `torchrl_nerd.modules.symmetric`: a layer of the same width has a quarter of the
products, one of twice the width as many. Errors are of passive test rollouts, in m and rad
at 100 and 500 steps.
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
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.robots import load_scene, preset_of, source_of
from torchrl_nerd.scenes import Scene
from torchrl_nerd.training.trainer import Trainer

HORIZONS: tuple[int, ...] = (100, 500)  # control steps
TEST_SEED, TEST_ROLLOUTS = 500, 512
NETWORKS = ("mlp-4x64", 1), ("mlp-4x64", 4), ("mlp-4x128", 4)


@dataclass
class Options:
    """What to train."""

    scene: str = "ant"
    seeds: tuple[int, ...] = (0, 1)
    trajectories: int = 5000
    steps: int = 3000
    """Updates on single steps; a tenth as many on rollouts follow."""
    json: Path | None = None
    """Write the results to this file."""


def trained(
    scene: Scene,
    config: TrainConfig,
    trajectories: int,
    horizons: tuple[int, ...],
    make: type[Trainer] = Trainer,
) -> tuple[NeRD, dict[str, Any]]:
    """A model, its number of weights and the time of an update on single steps."""
    data = simulate(scene, trajectories, 100, Generator().manual_seed(0))
    with tempfile.TemporaryDirectory() as folder:
        how = {"horizons": horizons, "quiet": True, "logger": "csv"}
        trainer = make(scene, data, source_of(scene), config, Path(folder), **how)
        began = time.process_time()
        trainer.run(until=config.steps)
        seconds = (time.process_time() - began) / config.steps
        model = trainer.run().eval()
    weights = sum(x.numel() for x in model.network.parameters())
    return model, {"weights": weights, "seconds_per_update": seconds}


def train(options: Options, network: str, symmetries: int, seed: int) -> dict[str, Any]:
    """Train one network and return its errors on test rollouts and the time taken."""
    scene = load_scene(options.scene)
    preset = preset_of(options.scene).train
    config = TrainConfig(
        network=network,
        symmetries=symmetries,
        use_symmetry=True,
        predicted_force=preset.predicted_force,
        loss_eps=preset.loss_eps,
        steps=options.steps,
        rollout_steps=options.steps // 10,
        rollout_lr_ratio=0.25,
        single_step_fraction=1.0,
        seed=seed,
    )
    model, about = trained(scene, config, options.trajectories, HORIZONS)
    both = NeRDDynamics(model), MujocoDynamics(scene)
    how = list(HORIZONS), TEST_ROLLOUTS, TEST_SEED
    errors = means_by_horizon(passive_errors(source_of(scene), *both, *how))
    named = {"network": network, "symmetries": symmetries, "seed": seed}
    return {**named, **about, **errors}


def main(options: Options) -> None:
    """Train all networks in turns and print, or write, what came of it."""
    torch.set_num_threads(1)
    results = []
    for seed in options.seeds:
        for network, symmetries in NETWORKS:
            results.append(train(options, network, symmetries, seed))
            print(results[-1], flush=True)
    write(options, results, TEST_ROLLOUTS)


def write(options: Any, rows: list[dict[str, Any]], rollouts: int) -> None:
    """Write the rows to ``options.json``, if there is one, with what they depend on."""
    if options.json is not None:
        about = {name: getattr(options, name) for name in ("scene", "steps")}
        about |= {"trajectories": options.trajectories, "test_rollouts": rollouts}
        write_results(options.json, {**about, "rows": rows}, TEST_SEED)


if __name__ == "__main__":
    main(tyro.cli(Options))
