"""A contact point a ten-millionth to either side of the margin at which it is seen."""

from typing import cast

import torch
from tensordict import TensorDict
from torch import Generator

from torchrl_nerd.evaluation.stability.case import Case, Figures, has_floating_base
from torchrl_nerd.evaluation.stability.measures import largest
from torchrl_nerd.evaluation.stability.states import settled
from torchrl_nerd.evaluation.stability.world import World
from torchrl_nerd.keys import QPOS
from torchrl_nerd.transforms import ContactFeatures

STEP = 1e-7  # m
JUMP, MOVE = "jump of a feature, m or m/s", "jump of the next state"


def _run(world: World, generator: Generator, scale: float) -> Figures:
    scene = world.scene
    rest = settled(scene, 16)
    z = scene.base.qpos_address + 2
    features = ContactFeatures(scene)
    start = rest.clone()
    low, high = (torch.full((len(rest),), x, dtype=torch.float64) for x in (0.0, 3.0))
    for _ in range(60):  # where the last point leaves its margin, by halving
        middle = 0.5 * (low + high)
        start[QPOS] = _lifted(rest[QPOS], z, middle)
        seen = features.contact_features(start[QPOS], start["qvel"])[0] < 0.0
        low = torch.where(seen.any(-1), middle, low)
        high = torch.where(seen.any(-1), high, middle)
    sides = [start.clone().set(QPOS, _lifted(rest[QPOS], z, x)) for x in (low, high)]
    sides[0][QPOS][:, z] -= STEP
    sides[1][QPOS][:, z] += STEP
    values = [
        torch.cat(features.contact_features(s[QPOS], s["qvel"]), -1) for s in sides
    ]
    ends = [cast(TensorDict, world.roll(s, 1)[:, -1]) for s in sides]
    moved = [torch.cat((e["qpos"], e["qvel"]), -1) for e in ends]
    return {
        JUMP: largest((values[0] - values[1]).abs()),
        MOVE: largest((moved[0] - moved[1]).abs()),
    }


def _lifted(qpos: torch.Tensor, z: int, height: torch.Tensor) -> torch.Tensor:
    lifted = qpos.clone()
    lifted[:, z] += height
    return lifted


CASE = Case(
    "margin",
    "what comes into sight comes gradually: features and motion do not jump",
    _run,
    has_floating_base,
    true_lines={JUMP: 1e-5, MOVE: 1e-5},
    lines={JUMP: 1e-5, MOVE: 1e-3},
)
