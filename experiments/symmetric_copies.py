"""Learned models averaged over symmetric copies of their robot: error and rate of each.

    python experiments/symmetric_copies.py ant --json results/symmetric_copies_ant.json

The protocol is that of `nerd eval`: the scene's cases and its longest horizon, against
MuJoCo, from test seeds. Rates are control steps per second of all copies in turns, on one
thread. `--export FOLDER --model ant-mlp --copies 4` writes one of the models to a folder,
which `dynamics=` and every command take.
"""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import cast

import torch
import tyro
from tyro.conf import Positional

from torchrl_nerd.checkpoint import (
    from_pretrained,
    make_card,
    save_checkpoint,
    shipped_card,
    shipped_models,
)
from torchrl_nerd.dynamics import MujocoDynamics, NeRDDynamics
from torchrl_nerd.evaluation.bench.candidates import Candidate, mujoco_name
from torchrl_nerd.evaluation.bench.errors import (
    cases_of,
    error_rows,
    evaluation_set,
    measure,
)
from torchrl_nerd.evaluation.bench.rates import rate_rows
from torchrl_nerd.evaluation.results import write_results
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.robots import load_scene, protocol_of
from torchrl_nerd.scenes import Scene
from torchrl_nerd.training.start import with_copies


@dataclass
class Options:
    """What to measure, or to write."""

    robot: Positional[str]
    """One whose shape has symmetries."""
    model: str | None = None
    """A model's name or folder; default: all shipped learned models of the robot."""
    copies: tuple[int, ...] = (1, 2, 4, 8)
    """Sizes of groups of symmetries."""
    num_trajectories: int = 512
    """Of each case."""
    seed: int = 500
    """Of the initial states; test seeds are never used in training or validation."""
    batch: int = 512
    """Trajectories stepped together, for the rates."""
    rounds: int = 15
    """Samples of each rate."""
    export: Path | None = None
    """Write the one model and number of copies that are given to this folder."""
    json: Path | None = None
    """Write the results to this file."""


def candidate(name: str, model: NeRD) -> Candidate:
    """A model in its own scene."""
    return Candidate(name, "learned", lambda scene: NeRDDynamics(model))


def candidates(options: Options, scene: Scene) -> list[Candidate]:
    """MuJoCo itself, and every model with every number of copies."""
    found = [Candidate(mujoco_name(scene), "simulator", MujocoDynamics)]
    names = [options.model] if options.model else learned_models(scene)
    for name in names:
        model = cast(NeRD, from_pretrained(name, scene))
        for count in options.copies:
            label = f"{name}, {count} cop{'y' if count == 1 else 'ies'}"
            found.append(candidate(label, with_copies(model, count).eval()))
    return found


def learned_models(scene: Scene) -> list[str]:
    """Shipped learned models of the scene."""
    return [x for x in shipped_models(scene) if shipped_card(x)["kind"] == "learned"]


def main(options: Options) -> None:
    """Measure and print, or write a model.

    Raises:
        ValueError: see `with_copies`; not one model and number of copies to write.
    """
    torch.set_num_threads(1)
    scene = load_scene(options.robot)
    if options.export is not None:
        export(options, scene, options.export)
        return
    protocol, shown = protocol_of(scene), candidates(options, scene)
    steps, rows = max(protocol.horizons), []
    for case, source, is_driven in cases_of(protocol):
        how = case, source, is_driven, lambda scene: MujocoDynamics(scene, 1)
        each = evaluation_set(*how, options.num_trajectories, steps, options.seed)
        errors = measure([each], shown[1:])
        found = error_rows(scene, case, steps, errors, protocol.published)
        for row in found:
            print(f"{case}, {row.name}, {row.quantity}: {row.mean:.4f} {row.unit}")
        rows += found
    source = next(iter(protocol.cases.values()))
    rates = rate_rows(shown, source, options.batch, options.rounds, options.seed)
    for rate in rates:
        print(f"{rate.name}: {rate.steps_per_s:,.0f} control steps/s")
    if options.json is not None:
        results = {
            "scene": scene.name,
            "steps": steps,
            "num_trajectories": options.num_trajectories,
            "batch": options.batch,
            "errors": [asdict(row) for row in rows],
            "rates": [asdict(row) for row in rates],
        }
        write_results(options.json, results, options.seed)


def export(options: Options, scene: Scene, folder: Path) -> None:
    """Write a model that averages over copies; its card says of which model it is."""
    if options.model is None or len(options.copies) != 1:
        raise ValueError("expected --model and one number of --copies with --export")
    model = cast(NeRD, from_pretrained(options.model, scene))
    averaged = with_copies(model, options.copies[0]).eval()
    about = {"training": {"copies_of": options.model}}
    save_checkpoint(averaged, folder, make_card(averaged, about))


if __name__ == "__main__":
    main(tyro.cli(Options))
