"""Alone, among 4,096, and in another order."""

import torch
from torch import Generator

from torchrl_nerd.evaluation.stability.case import Case, Figures
from torchrl_nerd.evaluation.stability.measures import largest
from torchrl_nerd.evaluation.stability.states import starts, uniform_torque
from torchrl_nerd.evaluation.stability.world import World
from torchrl_nerd.keys import QVEL

ROWS, STEPS, ALONE = 4096, 3, 8
APART, ORDER = "alone against among all, share", "in another order, share"


def _run(world: World, generator: Generator, scale: float) -> Figures:
    scene, rows = world.scene, max(ALONE, round(scale * ROWS))
    start = starts(scene, rows, generator)
    torque = uniform_torque(scene, rows, STEPS, generator)
    together = world.roll(start, STEPS, torque)[QVEL]
    order = torch.randperm(rows, generator=generator)
    shuffled = world.roll(start[order], STEPS, torque[order])[QVEL]
    alone = [
        world.roll(start[row : row + 1], STEPS, torque[row : row + 1])[QVEL]
        for row in range(ALONE)
    ]
    size = together.abs().amax((1, 2), keepdim=True) + 1.0
    return {
        APART: largest(((torch.cat(alone) - together[:ALONE]) / size[:ALONE]).abs()),
        ORDER: largest(((shuffled - together[order]) / size[order]).abs()),
    }


CASE = Case(
    "batching",
    "a row's motion is its own: float32 sums in another order are all that may differ",
    _run,
    true_lines={APART: 0.0, ORDER: 0.0},
    lines={APART: 1e-4, ORDER: 1e-4},
)
