"""Cubes without joints or motors: the paper's, over slopes, and the measured one."""

from functools import cache
from math import pi
from pathlib import Path

import mujoco
import torch
from torch import Generator, Tensor

from torchrl_nerd.geometry.constants import constant
from torchrl_nerd.geometry.rotations import matrix_from_quat
from torchrl_nerd.scenes.controllers import TorqueController
from torchrl_nerd.scenes.penalty_law import set_penalty_contact
from torchrl_nerd.scenes.sampling import BaseSampling, GroundSampler, Sampling
from torchrl_nerd.scenes.scene import Scene

SUBSTEPS = 20  # of 1/2960 s: control step 1/148 s, the real tosses' frame rate
# N/m, N s/m, N s/m, -; reference code. Stable: a corner weighs at least 0.21 kg, and
# kd dt / m = 1.6 < 2. In MuJoCo's friction cone slip also lifts: sliding
# at 1 m/s the cube hops by 1 mm, at 3 m/s by 9 mm, and slows down by mu g all the same.
CONTACT = {"ke": 1e4, "kd": 1e3, "kf": 50.0, "mu": 0.15}
# The paper's numbers times the ratio of the masses, so that both cubes fall and bounce
# alike. Its own damping of 1,000 N s/m would be unstable: over one substep it changes a
# corner's speed by 4.3 times that speed, where 2 is the limit.
LIGHTER = 0.37 / 1.15102
REAL_CONTACT = {k: v if k == "mu" else LIGHTER * v for k, v in CONTACT.items()}
HALF = 0.0524  # m, half the side

# Starts of tosses; reference code, env_cube_toss. Drawn again until all corners are clear.
START = BaseSampling(
    low=(-1.048, -1.048, 0.0472),
    high=(1.048, 1.048, 0.262),
    tilt=pi / 6,
    linear_low=(-3.5, -3.5, -1.0),
    linear_high=(3.5, 3.5, 0.2),
    angular_low=(-10.0, -10.0, -7.0),
    angular_high=(12.0, 8.0, 4.0),
)
CLEARANCE = 1e-3  # m
UP = (0.0, 0.0, 1.0)  # normal of level ground
STEEPEST = pi / 9  # rad; friction holds the cube up to atan(0.15) = 0.149


@cache
def cube() -> Scene:
    """Build the scene. ``qpos`` = centre (m), quaternion."""
    return _scene("cube", mujoco.MjSpec.from_file(str(cube_path("cube"))))


@cache
def cube_real() -> Scene:
    """Build the scene. ``qpos`` = centre (m), quaternion."""
    spec = mujoco.MjSpec.from_file(str(cube_path("cube_real")))
    return _scene("cube_real", spec, REAL_CONTACT)


@cache
def cube_slope() -> Scene:
    """Build the scene. ``qpos`` = centre (m), quaternion."""
    spec = mujoco.MjSpec.from_file(str(cube_path("cube")))
    level = spec.geom("ground")
    kept = ("type", "size", "contype", "conaffinity", "material", "rgba")
    slope = spec.worldbody.add_body(name="slope", mocap=True)
    slope.add_geom(name="slope", **{name: getattr(level, name) for name in kept})
    spec.delete(level)
    return _scene("cube_slope", spec, ground=sample_slope)


def cube_path(name: str) -> Path:
    """Where the cube of that name is described."""
    return Path(__file__).with_name(f"{name}.xml")


def _scene(
    name: str,
    spec: mujoco.MjSpec,
    contact: dict[str, float] = CONTACT,
    ground: GroundSampler | None = None,
) -> Scene:
    model = spec.compile()
    set_penalty_contact(model, **contact)
    no_joints = ((), (), (), (), ())
    sampling = Sampling(*no_joints, base=START, ground=ground, clearance=CLEARANCE)
    return Scene(name, model, SUBSTEPS, TorqueController(()), sampling)


def sample_slope(qpos: Tensor, generator: Generator) -> Tensor:
    """Random planes ``(n, 4)`` below cubes at ``qpos (n, 7)``, see `slope_beneath`."""
    u = torch.rand(len(qpos), 2, dtype=torch.float64, generator=generator)
    return slope_beneath(qpos, u)


def slope_beneath(qpos: Tensor, u: Tensor) -> Tensor:
    """Planes ``(*batch, 4)``, as far below cubes as level ground at height 0 would be.

    For ``qpos (*batch, 7)`` and ``u (*batch, 2)`` in [0, 1]: how steep, up to `STEEPEST`,
    and which way.
    """
    angle, heading = STEEPEST * u[..., 0], 2.0 * torch.pi * u[..., 1]
    across, up = angle.sin(), angle.cos()
    normal = torch.stack((across * heading.cos(), across * heading.sin(), up), -1)
    place, quat = qpos[..., :3], qpos[..., 3:]
    gap = place[..., 2] - cube_reach(quat, constant(quat, UP))
    offset = (normal * place).sum(-1) - cube_reach(quat, normal) - gap
    return torch.cat((normal, offset[..., None]), -1)  # (*batch, 3 + 1)


def cube_reach(quat: Tensor, direction: Tensor) -> Tensor:
    """How far a cube's corners are from its centre along a direction, m, ``(*batch,)``.

    ``quat (*batch, 4)``; ``direction (*batch, 3)`` is of unit length, in the world.
    """
    along = (direction[..., None, :] @ matrix_from_quat(quat))[..., 0, :]  # (*batch, 3)
    return HALF * along.abs().sum(-1)
