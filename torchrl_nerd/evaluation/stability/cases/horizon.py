"""A hundred thousand steps under torques of every kind."""

import torch
from torch import Generator

from torchrl_nerd.dynamics import NeRDDynamics
from torchrl_nerd.evaluation.stability.case import Case, Figures, has_motors
from torchrl_nerd.evaluation.stability.measures import length
from torchrl_nerd.evaluation.stability.states import (
    extreme_torques,
    starts,
    uniform_torque,
)
from torchrl_nerd.evaluation.stability.world import World
from torchrl_nerd.keys import QPOS, QVEL

ROWS, STEPS, KEPT = 4, 100_000, 1000  # rows of each kind
ROUNDING = 1e-6
BROKEN, LEAP = "rows that are no numbers", "leaps beyond speed times time, m"


def _run(world: World, generator: Generator, scale: float) -> Figures:
    scene = world.scene
    steps = max(KEPT, round(scale * STEPS) // KEPT * KEPT)
    torque = uniform_torque(scene, ROWS, 512, generator)
    if has_motors(scene):
        torque = torch.cat((torque, *extreme_torques(scene, ROWS, 512).values()))
    start = starts(scene, len(torque), generator)
    path = world.roll(start, steps, torque, steps // KEPT)
    state = torch.cat((path[QPOS], path[QVEL]), -1)
    broken = (~state.isfinite()).flatten(1).any(1)
    figures = {
        BROKEN: float(broken.sum()),
        "largest speed, m/s or rad/s": float(path[QVEL][~broken].abs().amax()),
        LEAP: 0.0,
    }
    if scene.base.is_floating and isinstance(world.dynamics, NeRDDynamics):
        q, v = scene.base.qpos_address, scene.base.dof_address
        moved = path[QPOS][:, 1:, q : q + 3] - path[QPOS][:, :-1, q : q + 3]
        limit = float(world.dynamics.model.training_range.speed[v])
        allowed = (1.0 + ROUNDING) * limit * scene.control_step * (steps // KEPT)
        figures[LEAP] = float((length(moved) - allowed).clamp(min=0.0).amax())
    return figures


CASE = Case(
    "horizon",
    "however long it runs and whatever drives it, every row stays finite and moves no "
    "farther than its speed allows",
    _run,
    lines={BROKEN: 0.0, LEAP: 0.0},
)
