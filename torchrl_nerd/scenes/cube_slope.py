"""The paper's cube over a plane of its own in every row: on level ground and on slopes."""

from math import pi

import mujoco
import torch
from torch import Generator, Tensor

from torchrl_nerd.scenes.cube import CONTACT, UP, cube_path, cube_reach, cube_scene
from torchrl_nerd.scenes.scene import Scene

STEEPEST = pi / 9  # rad; friction holds the cube up to atan(0.15) = 0.149


def cube_slope() -> Scene:
    """Build the scene. ``qpos`` = centre (m), quaternion."""
    spec = mujoco.MjSpec.from_file(str(cube_path("cube")))
    level = spec.geom("ground")
    slope = spec.worldbody.add_body(name="slope", mocap=True)
    slope.add_geom(
        name="slope",
        type=level.type,
        size=level.size,
        contype=level.contype,
        conaffinity=level.conaffinity,
        rgba=level.rgba,
    )
    spec.delete(level)
    scene = cube_scene("cube_slope", CONTACT, spec.compile(), sample_slope)
    return scene.foreseeing(True)


def sample_slope(qpos: Tensor, generator: Generator) -> Tensor:
    """Random planes ``(n, 4)`` below cubes at ``qpos (n, 7)``, see `slope_beneath`."""
    u = torch.rand(len(qpos), 2, dtype=torch.float64, generator=generator)
    return slope_beneath(qpos, u)


def slope_beneath(qpos: Tensor, u: Tensor) -> Tensor:
    """Planes ``(*batch, 4)``, as far below cubes as level ground at height 0 would be.

    Args:
        qpos: ``(*batch, 7)``.
        u: ``(*batch, 2)`` in [0, 1]: how steep, up to `STEEPEST`, and which way.
    """
    angle, heading = STEEPEST * u[..., 0], 2.0 * torch.pi * u[..., 1]
    across, up = angle.sin(), angle.cos()
    normal = torch.stack((across * heading.cos(), across * heading.sin(), up), -1)
    place, quat = qpos[..., :3], qpos[..., 3:]
    gap = place[..., 2] - cube_reach(quat, quat.new_tensor(UP))
    offset = (normal * place).sum(-1) - cube_reach(quat, normal) - gap
    return torch.cat((normal, offset[..., None]), -1)
