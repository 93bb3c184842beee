"""Joints pressed against their ends with all the torque there is.

A robot that stands on a leg for a while may fall to either side of it, and press its joints
otherwise. So a joint may go as far as any of MuJoCo's does from starts that are as good as
the same.
"""

from typing import cast

import mujoco
import torch
from tensordict import TensorDict
from torch import Generator, Tensor

from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.evaluation.stability.case import Case, Figures
from torchrl_nerd.evaluation.stability.measures import largest
from torchrl_nerd.evaluation.stability.states import nudged, starts
from torchrl_nerd.evaluation.stability.world import DynamicsWorld, World
from torchrl_nerd.keys import QPOS
from torchrl_nerd.scenes import Scene

ROWS, STEPS = 16, 200
NUDGE, NUDGES = 1e-2, 4  # of velocities, m/s and rad/s: a model's own error of a step
SCALARS = (int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE))
BEYOND = "beyond the end more than MuJoCo, rad or m"


def limited(scene: Scene) -> list[tuple[int, float, float]]:
    """Address and range of every limited hinge and slide."""
    model, found = scene.model, []
    for joint in range(model.njnt):
        is_scalar = int(model.jnt_type[joint]) in SCALARS
        if model.jnt_limited[joint] and is_scalar:
            low, high = model.jnt_range[joint]
            found.append((int(model.jnt_qposadr[joint]), float(low), float(high)))
    return found


def beyond(scene: Scene, path: TensorDict) -> Tensor:
    """How far beyond its end each limited joint went on a path, ``(rows, joints)``."""
    over, qpos = [], cast(Tensor, path[QPOS])
    for q, low, high in limited(scene):
        at = qpos[..., q]
        over.append(torch.maximum(low - at, at - high).amax(1))
    return torch.stack(over, -1).clamp(min=0.0)


def _run(world: World, generator: Generator, scale: float) -> Figures:
    scene = world.scene
    start = starts(scene, ROWS, generator)
    high = torch.tensor(scene.sampling.torque, dtype=torch.float64)
    side = torch.randint(2, (ROWS, 1, len(high)), generator=generator)
    torque = (2.0 * side - 1.0) * high
    truth = DynamicsWorld(MujocoDynamics(scene))
    beside = [nudged(start, NUDGE, generator) for _ in range(NUDGES)]
    own = beyond(scene, world.roll(start, STEPS, torque))
    others = [beyond(scene, truth.roll(s, STEPS, torque)) for s in (start, *beside)]
    other = torch.stack(others).amax(0)
    return {BEYOND: largest(own - other), "MuJoCo goes beyond by": largest(others[0])}


CASE = Case(
    "joint_limits",
    "a joint gives way at its end by no more than its spring allows, whichever way the "
    "robot falls",
    _run,
    lambda scene: bool(limited(scene)) and bool(len(scene.actuated)),
    true_lines={BEYOND: 1e-9},
    lines={BEYOND: 0.2},
)
