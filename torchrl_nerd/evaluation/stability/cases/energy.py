"""Energy of an undamped robot with a fixed base that touches nothing."""

import numpy as np
from torch import Generator

from torchrl_nerd.evaluation.stability.case import Case, Figures
from torchrl_nerd.evaluation.stability.world import (
    World,
    clear_of_ground,
    largest,
    mechanics,
    starts,
)
from torchrl_nerd.keys import QVEL
from torchrl_nerd.scenes import Scene

ROWS, STEPS, KEPT = 16, 1000, 20
DRIFT = "energy drift over 1,000 steps, share of its range"


def _applies(scene: Scene) -> bool:
    model = scene.model
    loses = model.dof_damping.any() or model.dof_frictionloss.any()
    is_limited = model.jnt_limited.any()
    return not (scene.base.is_floating or loses or is_limited)


def _run(world: World, generator: Generator, scale: float) -> Figures:
    start = clear_of_ground(world.scene, starts(world.scene, ROWS, generator))
    start[QVEL] = 0.3 * start[QVEL]
    steps = max(KEPT, round(scale * STEPS))
    path = world.roll(start, steps, every=steps // KEPT)
    energy = mechanics(world.scene, path.flatten())["energy"].reshape(ROWS, -1)
    # the height of the potential well and the motion's own energy are its scale
    well = sum(world.scene.model.body_mass) * 9.81 * world.scene.model.stat.extent
    drift = np.abs(energy - energy[:, :1]) / (well + np.abs(energy[:, :1]))
    return {DRIFT: largest(drift.mean(0)), "worst row": largest(drift)}


CASE = Case(
    "energy",
    "nothing rubs and nothing drives: kinetic plus potential energy stays as it is",
    _run,
    _applies,
    true_lines={DRIFT: 0.005},
    lines={DRIFT: 0.005},
)
