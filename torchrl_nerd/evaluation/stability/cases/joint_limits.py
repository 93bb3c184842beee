"""Joints pressed against their ends with all the torque there is."""

import mujoco
import torch
from torch import Generator

from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.evaluation.stability.case import Case, Figures
from torchrl_nerd.evaluation.stability.measures import largest
from torchrl_nerd.evaluation.stability.states import starts
from torchrl_nerd.evaluation.stability.world import DynamicsWorld, World
from torchrl_nerd.keys import QPOS
from torchrl_nerd.scenes import Scene

ROWS, STEPS = 16, 200
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


def _run(world: World, generator: Generator, scale: float) -> Figures:
    scene = world.scene
    start = starts(scene, ROWS, generator)
    high = torch.tensor(scene.sampling.torque, dtype=torch.float64)
    side = torch.randint(2, (ROWS, 1, len(high)), generator=generator)
    torque = (2.0 * side - 1.0) * high
    truth = DynamicsWorld(MujocoDynamics(scene))
    mine, true = (w.roll(start, STEPS, torque)[QPOS] for w in (world, truth))
    beyond = [
        torch.maximum(-(x[..., q] - low), x[..., q] - top).amax(1).clamp(min=0.0)
        for x in (mine, true)
        for q, low, top in limited(scene)
    ]
    own, other = torch.stack(beyond).unflatten(0, (2, -1))
    return {BEYOND: largest(own - other), "MuJoCo goes beyond by": largest(other)}


CASE = Case(
    "joint_limits",
    "a joint gives way at its end by no more than its spring allows",
    _run,
    lambda scene: bool(limited(scene)) and bool(len(scene.actuated)),
    true_lines={BEYOND: 1e-9},
    lines={BEYOND: 0.2},
)
