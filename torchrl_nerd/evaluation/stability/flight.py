"""A free robot in the air, moving slowly enough for MuJoCo's own steps to be exact."""

import numpy as np
from torch import Generator

from torchrl_nerd.evaluation.stability.measures import mechanics
from torchrl_nerd.evaluation.stability.states import clear_of_ground, starts
from torchrl_nerd.evaluation.stability.world import World
from torchrl_nerd.keys import QVEL

ROWS, STEPS = 16, 30
QUIET = 0.3  # of the training speeds: MuJoCo's own steps lose momentum at more


def quiet_flight(world: World, generator: Generator) -> dict[str, np.ndarray]:
    """Centre of mass, momentum and spin on the way, ``(ROWS, STEPS + 1, 3)``.

    See `mechanics`.
    """
    start = clear_of_ground(world.scene, starts(world.scene, ROWS, generator))
    start[QVEL] = QUIET * start[QVEL]
    path = world.roll(start, STEPS)
    found = mechanics(world.scene, path.flatten())
    return {key: found[key].reshape(ROWS, -1, 3) for key in ("com", "momentum", "spin")}
