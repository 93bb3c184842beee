"""A hinge without limits, turned a hundred times before it starts."""

import mujoco
import torch
from torch import Generator

from torchrl_nerd.evaluation.stability.case import Case, Figures
from torchrl_nerd.evaluation.stability.measures import apart, largest
from torchrl_nerd.evaluation.stability.states import starts, uniform_torque
from torchrl_nerd.evaluation.stability.world import World
from torchrl_nerd.keys import QPOS
from torchrl_nerd.scenes import Scene

ROWS, STEPS, TURNS = 16, 20, 100
APART = "apart after 20 steps, rad"


def free_hinges(scene: Scene) -> list[int]:
    """Addresses in ``qpos``."""
    model = scene.model
    return [
        int(model.jnt_qposadr[joint])
        for joint in range(model.njnt)
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE
        and not model.jnt_limited[joint]
        and not model.jnt_stiffness[joint]
    ]


def _run(world: World, generator: Generator, scale: float) -> Figures:
    scene = world.scene
    start = starts(scene, ROWS, generator)
    turned = start.clone()
    turned[QPOS][:, free_hinges(scene)] += 2.0 * torch.pi * TURNS
    torque = uniform_torque(scene, ROWS, STEPS, generator)
    paths = [world.roll(s, STEPS, torque)[QPOS] for s in (start, turned)]
    return {APART: largest(apart(scene, *paths))}


CASE = Case(
    "hinge_turns",
    "a hundred turns of a hinge change nothing",
    _run,
    lambda scene: bool(free_hinges(scene)),
    true_lines={APART: 1e-6},
    lines={APART: 1e-6},
)
