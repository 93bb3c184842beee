"""Open-loop error against data, updates and the size of the model, Cartpole by default.

    python experiments/scaling_error.py

Trains one network on every size of data and by every number of updates, then all others on
most data by most updates; what is finished is read, so that a run that was cut short goes
on.
"""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

import tyro
from tensordict import TensorDict
from torch import Generator

from torchrl_nerd.checkpoint import CARD, load_checkpoint
from torchrl_nerd.configs import TrainConfig
from torchrl_nerd.data.simulate import is_sound, simulate
from torchrl_nerd.dynamics import MujocoDynamics, NeRDDynamics
from torchrl_nerd.evaluation.results import write_results
from torchrl_nerd.evaluation.rollout_error import passive_errors
from torchrl_nerd.files import read_json, write_json
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.robots import load_scene, preset_of, source_of
from torchrl_nerd.training.trainer import Trainer

TEST_SEED = 500  # of starts; never one of training or validation
STEPS = 100  # of a trajectory


@dataclass
class Options:
    """What to train, and how long."""

    scene: str = "cartpole"
    trajectories: tuple[int, ...] = (20, 100, 500, 2500)
    """Sizes of data, of 100 transitions each; the largest is that of all others."""
    networks: tuple[str, ...] = ("mlp-1x16", "mlp-2x32", "mlp-4x64")
    """Beside the first one, by the largest data and the most updates."""
    first: str = "mlp-1x32"
    updates: tuple[int, ...] = (300, 1_000, 3_000)
    """On 1,024 single states each; the largest number is that of all others."""
    rows: int = 256
    """Trajectories of the test."""
    horizons: tuple[int, ...] = (100, 500)
    """Control steps of its errors."""
    seed: int = 0
    out: Path = Path("runs/scaling_error")
    json: Path | None = None
    """Write the results to this file."""


def measure(
    data: TensorDict, network: str, trajectories: int, updates: int, options: Options
) -> dict[str, Any]:
    """Results of one training, made as far as they are not there."""
    name = f"{network}_{trajectories}_{updates}_{options.seed}"
    folder = options.out / options.scene / name
    # all data are the first ones of one draw, whose random numbers its size decides
    settings = {"rows": options.rows, "horizons": list(options.horizons)}
    settings |= {"drawn": max(options.trajectories)}
    path = folder / "results.json"
    if path.exists() and read_json(path)["settings"] == settings:
        return read_json(path)
    scene, preset = load_scene(options.scene), preset_of(options.scene)
    config = TrainConfig(
        network=network,
        steps=updates,
        rollout_steps=0,
        single_step_fraction=1.0,
        loss_eps=preset.train.loss_eps,
        validate_every=updates,
        seed=options.seed,
    )
    some = cast(TensorDict, data[:trajectories])
    source, horizons = source_of(scene), options.horizons
    Trainer(scene, some, source, config, folder, horizons=horizons).run()
    model = cast(NeRD, load_checkpoint(folder / "last", scene))
    errors = passive_errors(
        source,
        NeRDDynamics(model),
        MujocoDynamics(scene),
        list(horizons),
        options.rows,
        TEST_SEED,
    )
    results = {
        "network": network,
        "parameters": sum(w.numel() for w in model.network.parameters()),
        "transitions": some.numel(),
        "updates": updates,
        "seconds": read_json(folder / "last" / CARD)["training"]["seconds"],
        "errors": {
            str(horizon): {name: asdict(e) for name, e in by_name.items()}
            for horizon, by_name in errors.items()
        },
        "settings": settings,
    }
    write_json(path, results)
    return results


def run(options: Options) -> Iterator[dict[str, Any]]:
    """Results of every size of data, every number of updates, every network."""
    largest, longest = max(options.trajectories), max(options.updates)
    generator = Generator().manual_seed(options.seed)
    data = simulate(load_scene(options.scene), largest, STEPS, generator)
    data = cast(TensorDict, data[is_sound(data)])
    for trajectories in options.trajectories:
        yield measure(data, options.first, trajectories, longest, options)
    for updates in sorted(set(options.updates) - {longest}):
        yield measure(data, options.first, largest, updates, options)
    for network in options.networks:
        yield measure(data, network, largest, longest, options)


def main(options: Options) -> list[dict[str, Any]]:
    """Print and return the results."""
    found = []
    for results in run(options):
        found.append(results)
        errors = "  ".join(
            f"{name} {e['mean']:.4f} {e['unit']} at {horizon}"
            for horizon, by_name in results["errors"].items()
            for name, e in by_name.items()
        )
        sizes = (
            f"{results['parameters']:>9,} weights {results['transitions']:>9,} steps "
            f"{results['updates']:>6,} updates {results['seconds']:>5.0f} s"
        )
        print(f"{results['network']:<16}{sizes}  {errors}", flush=True)
        if options.json is not None:
            write_results(options.json, found, options.seed)
    return found


if __name__ == "__main__":
    main(tyro.cli(Options))
