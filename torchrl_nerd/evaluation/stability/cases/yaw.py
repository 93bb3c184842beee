"""The same motion in any direction."""

import torch
from torch import Generator

from torchrl_nerd.evaluation.stability.case import Case, Figures
from torchrl_nerd.evaluation.stability.cases.translation import applies
from torchrl_nerd.evaluation.stability.measures import apart, largest
from torchrl_nerd.evaluation.stability.states import starts, turned
from torchrl_nerd.evaluation.stability.world import World
from torchrl_nerd.keys import QPOS

ROWS, STEPS = 16, 10
APART = "apart after 10 steps, m or rad"


def _run(world: World, generator: Generator, scale: float) -> Figures:
    scene = world.scene
    start = starts(scene, ROWS, generator)
    half = torch.pi * torch.rand(ROWS, 1, generator=generator).double()
    zero = torch.zeros_like(half)
    turn = torch.cat((half.cos(), zero, zero, half.sin()), -1)
    here = turned(scene, world.roll(start, STEPS), turn[:, None])
    there = world.roll(turned(scene, start, turn), STEPS)
    worst = apart(scene, here[QPOS], there[QPOS]).amax(1)
    return {APART: float(worst.median()), "worst row": largest(worst)}


CASE = Case(
    "yaw",
    "level ground is the same in every direction; MuJoCo's friction is a cone in all of "
    "them, so the true motion turns along too",
    _run,
    applies,
    true_lines={APART: 1e-4},
    lines={APART: 1e-4},
)
