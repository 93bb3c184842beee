"""A quaternion and its negative are the same orientation."""

from torch import Generator

from torchrl_nerd.evaluation.stability.case import Case, Figures, has_floating_base
from torchrl_nerd.evaluation.stability.measures import apart, largest
from torchrl_nerd.evaluation.stability.states import starts, uniform_torque
from torchrl_nerd.evaluation.stability.world import World
from torchrl_nerd.keys import QPOS

ROWS, STEPS = 16, 10
APART = "apart after 10 steps, m or rad"


def _run(world: World, generator: Generator, scale: float) -> Figures:
    scene, q = world.scene, world.scene.base.qpos_address + 3
    start = starts(scene, ROWS, generator)
    other = start.clone()
    other[QPOS][:, q : q + 4] *= -1.0
    torque = uniform_torque(scene, ROWS, STEPS, generator)
    paths = [world.roll(s, STEPS, torque)[QPOS] for s in (start, other)]
    return {APART: largest(apart(scene, *paths))}


CASE = Case(
    "quaternion_sign",
    "q and -q move alike",
    _run,
    has_floating_base,
    true_lines={APART: 1e-6},
    lines={APART: 1e-6},
)
