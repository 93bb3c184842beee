"""Gravity and the floor tilted together."""

import torch
from torch import Generator, Tensor

from torchrl_nerd.dynamics import MujocoDynamics, NeRDDynamics
from torchrl_nerd.evaluation.stability.case import Case, Figures
from torchrl_nerd.evaluation.stability.cases.translation import applies
from torchrl_nerd.evaluation.stability.measures import apart, largest
from torchrl_nerd.evaluation.stability.states import (
    ground_turned,
    starts,
    turned,
)
from torchrl_nerd.evaluation.stability.world import DynamicsWorld, World
from torchrl_nerd.geometry.rotations import rotate
from torchrl_nerd.keys import QPOS
from torchrl_nerd.scenes import Scene

ROWS, STEPS = 16, 10
APART = "apart after 10 steps, m or rad"


def tilted(scene: Scene, turn: Tensor) -> Scene:
    """The robot in a world that is turned by a quaternion ``(4,)``, its floor too."""
    there = ground_turned(scene, turn)
    gravity = torch.from_numpy(scene.model.opt.gravity.copy())
    there.model.opt.gravity[:] = rotate(turn, gravity).numpy()
    return there


def _run(world: World, generator: Generator, scale: float) -> Figures:
    start = starts(world.scene, ROWS, generator)
    way = torch.randn(4, generator=generator, dtype=torch.float64)
    turn = way / torch.linalg.vector_norm(way)
    here = turned(world.scene, world.roll(start, STEPS), turn)
    other = _over(world, tilted(world.scene, turn))
    there = other.roll(turned(world.scene, start, turn), STEPS)
    worst = apart(world.scene, here[QPOS], there[QPOS]).amax(1)
    return {APART: float(worst.median()), "worst row": largest(worst)}


def _over(world: World, scene: Scene) -> World:
    """The same dynamics of another scene, whose features are the same."""
    if not isinstance(world.dynamics, NeRDDynamics):
        return DynamicsWorld(MujocoDynamics(scene))
    old = world.dynamics.model
    model = old.copy_for(scene)
    model.load_state_dict(old.state_dict())
    return DynamicsWorld(NeRDDynamics(model.to(old.device)))


CASE = Case(
    "tilt",
    "down is where gravity points: robot, floor and gravity turned together move alike",
    _run,
    applies,
    true_lines={APART: 1e-4},
    lines={APART: 1e-4},
    needs_dynamics=True,
)
