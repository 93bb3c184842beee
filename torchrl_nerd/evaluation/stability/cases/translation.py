"""The same motion up to a thousand kilometres away."""

from torch import Generator

from torchrl_nerd.evaluation.stability.case import Case, Figures, has_floating_base
from torchrl_nerd.evaluation.stability.measures import apart, largest
from torchrl_nerd.evaluation.stability.states import starts
from torchrl_nerd.evaluation.stability.world import World
from torchrl_nerd.keys import QPOS
from torchrl_nerd.scenes import Scene

ROWS, STEPS = 8, 10
NEAR, FAR = "apart after 10 steps, 1 m to 10 km away", "1,000 km away"


def applies(scene: Scene) -> bool:
    """Whether a floating base stands on one fixed plane."""
    plane = scene.terrain is not None and scene.terrain.fixed_plane is not None
    return has_floating_base(scene) and plane


def _run(world: World, generator: Generator, scale: float) -> Figures:
    scene, q = world.scene, world.scene.base.qpos_address
    start = starts(scene, ROWS, generator)
    here = world.roll(start, STEPS)[QPOS]
    farthest = {}
    for distance in (1.0, 1e2, 1e4, 1e6):
        other = start.clone()
        other[QPOS][:, q] += distance
        there = world.roll(other, STEPS)[QPOS]
        there[..., q] -= distance
        farthest[distance] = largest(apart(scene, here, there))
    return {NEAR: max(farthest[d] for d in (1.0, 1e2, 1e4)), FAR: farthest[1e6]}


CASE = Case(
    "translation",
    "level ground is the same everywhere; a float64 holds 1e-10 m at 1,000 km",
    _run,
    applies,
    true_lines={NEAR: 1e-4},
    lines={NEAR: 1e-4, FAR: 1e-2},
)
