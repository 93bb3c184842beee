"""Drops from a tenth of a metre to ten, most of them faster than any in training."""

import torch
from torch import Generator

from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.evaluation.stability.case import Case, Figures, has_floating_base
from torchrl_nerd.evaluation.stability.measures import largest
from torchrl_nerd.evaluation.stability.states import rows_of, settled
from torchrl_nerd.evaluation.stability.world import DynamicsWorld, World
from torchrl_nerd.keys import QPOS

HEIGHTS = (0.1, 0.3, 1.0, 3.0, 10.0)  # m
STEPS = 300
LOW, HIGH = "sinks below where it lay, m", "bounces above the drop, m"


def _run(world: World, generator: Generator, scale: float) -> Figures:
    rest = settled(world.scene, 16)
    z = world.scene.base.qpos_address + 2
    start = rows_of(rest, torch.zeros(len(HEIGHTS), dtype=torch.long))
    start[QPOS][:, z] += torch.tensor(HEIGHTS, dtype=torch.float64)
    height = world.roll(start, STEPS)[QPOS][..., z]
    true = DynamicsWorld(MujocoDynamics(world.scene)).roll(start, STEPS)[QPOS][..., z]
    end = (height[:, -1] - true[:, -1]).abs()
    return {
        LOW: largest(true.amin(1) - height.amin(1)),
        HIGH: largest((height[:, 1:] - height[:, :1]).amax(1)),
        **{
            f"height at the end, dropped {h:g} m, against MuJoCo, m": float(e)
            for h, e in zip(HEIGHTS, end, strict=True)
        },
    }


CASE = Case(
    "drop",
    "dropped flat from rest it lands, does not sink in, and never rises above the drop",
    _run,
    has_floating_base,
    true_lines={LOW: 1e-9, HIGH: 1e-3},
    lines={LOW: 0.05, HIGH: 0.02},
)
