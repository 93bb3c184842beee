"""A hundred thousand steps under random torques."""

import torch
from torch import Generator

from torchrl_nerd.dynamics import NeRDDynamics
from torchrl_nerd.evaluation.stability.case import Case, Figures
from torchrl_nerd.evaluation.stability.measures import length
from torchrl_nerd.evaluation.stability.states import starts, uniform_torque
from torchrl_nerd.evaluation.stability.world import World
from torchrl_nerd.keys import QPOS, QVEL

ROWS, STEPS, KEPT = 4, 100_000, 1000
BROKEN, LEAP = "rows that are no numbers", "leaps beyond speed times time, m"


def _run(world: World, generator: Generator, scale: float) -> Figures:
    scene = world.scene
    steps = max(KEPT, round(scale * STEPS) // KEPT * KEPT)
    torque = uniform_torque(scene, ROWS, 512, generator)
    path = world.roll(starts(scene, ROWS, generator), steps, torque, steps // KEPT)
    state = torch.cat((path[QPOS], path[QVEL]), -1)
    figures = {
        BROKEN: float((~state.isfinite()).flatten(1).any(1).sum()),
        "largest speed, m/s or rad/s": float(path[QVEL].abs().amax()),
    }
    if scene.base.is_floating and isinstance(world.dynamics, NeRDDynamics):
        q, v = scene.base.qpos_address, scene.base.dof_address
        moved = path[QPOS][:, 1:, q : q + 3] - path[QPOS][:, :-1, q : q + 3]
        limit = float(world.dynamics.model.coverage.speed[v])
        allowed = 1.5 * limit * scene.control_step * (steps // KEPT)
        figures[LEAP] = float((length(moved) - allowed).clamp(min=0.0).amax())
    return figures


CASE = Case(
    "horizon",
    "however long it runs, every row stays finite and moves no farther than its speed "
    "allows",
    _run,
    lines={BROKEN: 0.0},
)
