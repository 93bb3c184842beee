"""A rigid body tumbling about its middle axis against Euler's equations."""

import mujoco
import numpy as np
import torch
from scipy.integrate import solve_ivp
from torch import Generator

from torchrl_nerd.evaluation.stability.case import Case, Figures
from torchrl_nerd.evaluation.stability.measures import largest
from torchrl_nerd.evaluation.stability.states import clear_of_ground, starts
from torchrl_nerd.evaluation.stability.world import World
from torchrl_nerd.geometry.rotations import quat_matrix
from torchrl_nerd.keys import QVEL
from torchrl_nerd.scenes import Scene

ROWS, STEPS = 16, 30
SPIN, WOBBLE = 3.0, 0.01  # rad/s about the middle axis; its share about the others
OFF = "off Euler's equations, share of the spin, after 30 steps"


def applies(scene: Scene) -> bool:
    """Whether the robot is one free rigid body."""
    kinds = scene.model.jnt_type
    return len(kinds) == 1 and kinds[0] == mujoco.mjtJoint.mjJNT_FREE


def _run(world: World, generator: Generator, scale: float) -> Figures:
    scene, v = world.scene, world.scene.base.dof_address + 3
    body = int(scene.model.jnt_bodyid[0])
    inertia = scene.model.body_inertia[body]
    axes = quat_matrix(scene.model.body_iquat[body])
    noise = torch.randn(ROWS, 3, generator=generator, dtype=torch.float64).numpy()
    first = SPIN * (np.eye(3)[np.argsort(inertia)[1]] + WOBBLE * noise)
    start = clear_of_ground(scene, starts(scene, ROWS, generator))
    start[QVEL] = 0.0 * start[QVEL]
    start[QVEL][:, v:] = torch.from_numpy(first @ axes.T)
    path = world.roll(start, STEPS)[QVEL][..., v:].numpy() @ axes
    exact = np.stack([_spin(inertia, row, scene.control_step) for row in first])
    return {OFF: largest(np.linalg.norm(path - exact, axis=-1).mean(0)) / SPIN}


def _spin(inertia: np.ndarray, first: np.ndarray, step: float) -> np.ndarray:
    """Angular velocity about principal axes ``(STEPS + 1, 3)``, free of torque."""

    def rate(_: float, spin: np.ndarray) -> np.ndarray:
        return np.cross(inertia * spin, spin) / inertia

    times = step * np.arange(STEPS + 1)
    found = solve_ivp(
        rate, (0.0, times[-1]), first, t_eval=times, rtol=1e-10, atol=1e-12
    )
    return found.y.T


CASE = Case(
    "tumbling",
    "about the middle of three axes a body turns over, as Euler's equations say; a cube, "
    "whose axes are alike, keeps its spin",
    _run,
    applies,
    true_lines={OFF: 5e-3},
    lines={OFF: 0.02},
)
