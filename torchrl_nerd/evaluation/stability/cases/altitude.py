"""The same flight at any height, where no contact point sees the ground."""

from torch import Generator

from torchrl_nerd.evaluation.stability.case import Case, Figures, has_floating_base
from torchrl_nerd.evaluation.stability.measures import apart, largest
from torchrl_nerd.evaluation.stability.states import (
    clear_of_ground,
    starts,
    uniform_torque,
)
from torchrl_nerd.evaluation.stability.world import World
from torchrl_nerd.keys import QPOS

ROWS, STEPS = 8, 10
APART = "apart after 10 steps, 1 m to 1,000 km higher"


def _run(world: World, generator: Generator, scale: float) -> Figures:
    scene, z = world.scene, world.scene.base.qpos_address + 2
    start = clear_of_ground(scene, starts(scene, ROWS, generator))
    torque = uniform_torque(scene, ROWS, STEPS, generator)
    here = world.roll(start, STEPS, torque)[QPOS]
    farthest = 0.0
    for height in (1.0, 1e3, 1e6):
        other = start.clone()
        other[QPOS][:, z] += height
        there = world.roll(other, STEPS, torque)[QPOS]
        there[..., z] -= height
        farthest = max(farthest, largest(apart(scene, here, there)))
    return {APART: farthest}


CASE = Case(
    "altitude",
    "contact points beyond their margin say nothing: how far beyond makes no difference",
    _run,
    has_floating_base,
    true_lines={APART: 1e-6},
    lines={APART: 1e-6},
)
