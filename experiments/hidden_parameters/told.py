"""A model that is told its robot's parameters, on which its output does not depend yet.

    python -m experiments.hidden_parameters.told ant-mlp runs/ant_told_start
    nerd train ant --vary preset --parameters --init-from runs/ant_told_start ...

The oracle of a robot whose shipped model was never told any: training goes on from there.
"""

from dataclasses import replace
from pathlib import Path

import torch
import tyro
from torch import Tensor

from torchrl_nerd.checkpoint import from_pretrained, make_card, save_checkpoint
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.robots import load_scene, preset_of

SPREAD = 3.0**-0.5  # standard deviation of a uniform number from -1 to 1
BEGINNINGS = {"weight": 0.0, "mean": 0.0, "std": SPREAD, "entry_signs": 1.0}
"""What a new entry of the token begins with; its bounds follow from the spread."""


def told(start: NeRD) -> NeRD:
    """A copy of a learned model whose tokens have the parameters of the preset as well.

    Raises:
        ValueError: a hybrid, or a robot whose preset varies nothing.
    """
    scene = start.scene.vary(preset_of(start.scene.name).variation)
    if type(start) is not NeRD or scene.variation is None:
        raise ValueError(
            "expected a learned model of a robot whose preset has a variation, got a "
            f"{start.kind} one of '{scene.name}'"
        )
    features = replace(start.scene_features.config, parameters=True)
    model = NeRD(scene, features, start.config)
    at = sum(start.scene_features.robot.sizes.values())  # behind state and drive
    size, new = start.token_size, scene.variation.size
    known, found = start.state_dict(), {}
    for name, mine in model.state_dict().items():
        old = known[name]
        if name.startswith("ood."):  # fitted to the data that the training has
            old = mine
        elif name.endswith(".sources") and old.shape[-1] == size:
            moved = torch.where(old < at, old, old + new)
            old = insert(moved, at, new, 0)
            old[:, at : at + new] = torch.arange(at, at + new)
        elif mine.shape != old.shape:
            end = name.rpartition("feature_")[2] if "feature_" in name else ""
            bounds = {"low": -1.0 / SPREAD, "high": 1.0 / SPREAD}
            kind = name.rpartition(".")[2].rpartition("key_token_")[2]
            old = insert(old, at, new, bounds.get(end, BEGINNINGS.get(kind, 0.0)))
        found[name] = old
    model.load_state_dict(found)
    model.reference_ratio = start.reference_ratio
    return model


def insert(x: Tensor, at: int, count: int, value: float) -> Tensor:
    """``x (*batch, size)`` with ``count`` entries of a value from ``at`` on."""
    entries = x.new_full((*x.shape[:-1], count), value)
    return torch.cat((x[..., :at], entries, x[..., at:]), -1)


def main(model: tyro.conf.Positional[str], out: tyro.conf.Positional[Path]) -> None:
    """Write the checkpoint ``out`` that begins as the shipped ``model``."""
    start = from_pretrained(model, load_scene(model.partition("-")[0]))
    assert isinstance(start, NeRD)  # no analytic step has this name
    found = told(start)
    save_checkpoint(found, out, make_card(found))


if __name__ == "__main__":
    tyro.cli(main)
