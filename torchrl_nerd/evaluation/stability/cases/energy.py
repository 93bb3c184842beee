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
DRIFT = "energy drift over 1,000 steps, share of the well's depth"


def _applies(scene: Scene) -> bool:
    model = scene.model
    loses = model.dof_damping.any() or model.dof_frictionloss.any()
    hangs = model.opt.gravity.any()
    return bool(hangs and not (scene.base.is_floating or loses))


def _run(world: World, generator: Generator, scale: float) -> Figures:
    scene = world.scene
    start = clear_of_ground(scene, starts(scene, ROWS, generator))
    start[QVEL] = 0.0 * start[QVEL]  # or a cart would roll off to the end of its rail
    steps = max(KEPT, round(scale * STEPS))
    path = world.roll(start, steps, every=steps // KEPT)
    energy = mechanics(scene, path.flatten())["energy"].reshape(ROWS, -1)
    well = energy[:, 0].max() - _lowest(scene)
    drift = np.abs(energy - energy[:, :1]) / well
    return {DRIFT: largest(drift.mean(0)), "worst row": largest(drift)}


def _lowest(scene: Scene) -> float:
    """Potential energy of the robot hanging down, as far as random poses find it."""
    poses = clear_of_ground(scene, starts(scene, 512, Generator().manual_seed(0)))
    poses[QVEL] = 0.0 * poses[QVEL]
    return float(mechanics(scene, poses)["energy"].min())


CASE = Case(
    "energy",
    "nothing rubs and nothing drives: kinetic plus potential energy stays as it is",
    _run,
    _applies,
    true_lines={DRIFT: 0.005},
    lines={DRIFT: 0.005},
)
