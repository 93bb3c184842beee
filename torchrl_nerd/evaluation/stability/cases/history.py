"""A row reset, or put elsewhere, in mid-flight is as new."""

import copy
from typing import cast

import torch
from tensordict import TensorDict
from torch import Generator, Tensor

from torchrl_nerd.dynamics import Dynamics
from torchrl_nerd.evaluation.stability.case import Case, Figures
from torchrl_nerd.evaluation.stability.measures import largest
from torchrl_nerd.evaluation.stability.states import starts, uniform_torque
from torchrl_nerd.evaluation.stability.world import DynamicsWorld, World
from torchrl_nerd.keys import QPOS, QVEL, TERRAIN

ROWS, STEPS = 16, 12
APART = "apart from a fresh start, share"
COPY = "numbers that differ in a copy made in mid-flight"


def _run(world: World, generator: Generator, scale: float) -> Figures:
    dynamics = world.dynamics
    assert dynamics is not None  # for the type checker: the case needs it
    scene = world.scene
    start, other = (starts(scene, ROWS, generator) for _ in range(2))
    torque = uniform_torque(scene, ROWS, STEPS, generator)
    rows = torch.rand(ROWS, generator=generator) < 0.5
    flying = cast(TensorDict, world.roll(start, STEPS, torque)[:, -1])
    state = torch.where(rows[:, None], other[QPOS], flying[QPOS])
    speed = torch.where(rows[:, None], other[QVEL], flying[QVEL])
    mixed = other.clone().set(QPOS, state).set(QVEL, speed)
    if TERRAIN in start.keys():
        mixed[TERRAIN] = torch.where(rows[:, None], other[TERRAIN], start[TERRAIN])
    dynamics.reset(mixed, rows)
    twin = copy.deepcopy(dynamics)
    apart = DynamicsWorld(copy.deepcopy(dynamics))
    path = cast(TensorDict, apart.roll(mixed, STEPS, torque))
    after, again = (_along(d, path, mixed, torque) for d in (dynamics, twin))
    fresh = path[QVEL][rows, 1:]
    size = 1.0 + fresh.abs().amax((1, 2), keepdim=True)
    return {
        APART: largest(((after[rows] - fresh) / size).abs()),
        COPY: float((after != again).sum()),
    }


def _along(
    dynamics: Dynamics, path: TensorDict, mixed: TensorDict, torque: Tensor
) -> Tensor:
    """Velocities ``(rows, STEPS, nv)`` from every state of a path, with one history.

    From the path's own states, so that round-off does not grow with the steps.
    """
    terrain, after = mixed.get(TERRAIN, None), []
    for step in range(STEPS):
        now = cast(TensorDict, path[:, step]).select(QPOS, QVEL)
        after.append(dynamics.step(now, torque[:, step], terrain)[QVEL])
    return torch.stack(after, 1)


CASE = Case(
    "history",
    "nothing of a row's past outlives its reset",
    _run,
    true_lines={APART: 1e-6, COPY: 0.0},
    lines={APART: 1e-5, COPY: 0.0},
    needs_dynamics=True,
)
