"""Signed distance and normal of points to ground surfaces, batched.

Every function takes points ``(*batch, P, 3)`` and returns the signed distance
``(*batch, P)`` (m, negative inside) and the outward unit normal ``(*batch, P, 3)``, both
at the closest point of the surface, which is ``point - distance * normal``. A plane is
given by its equation in the points' frame. The other shapes stand in a frame of their own
as MuJoCo's geoms do, with MuJoCo's sizes ``(3,)`` or ``(*batch, 3)``; `into_frame` takes
points there. A height field, which has more to say, is in `height_fields`.
"""

from collections.abc import Callable

import mujoco
import torch
from torch import Tensor

PLANE_PARAMETERS = 4
"""Unit normal (3) and offset: ``normal . x = offset``."""

ON_SURFACE = 1e-12  # m: closer to a centre or an edge, the direction is rounding


def plane_distance(points: Tensor, plane: Tensor) -> tuple[Tensor, Tensor]:
    """To a plane ``(*batch, 4)``: unit normal, offset in m.

    Like all distances here: of points ``(*batch, P, 3)``, m, in the surface's frame, signed
    ``(*batch, P)``, m, and with it the normal there ``(*batch, P, 3)``.
    """
    normal, offset = plane[..., :3], plane[..., 3:]
    distance = (points @ normal[..., None])[..., 0] - offset
    return distance, normal[..., None, :].expand_as(points)


def plane_in_frame(plane: Tensor, position: Tensor, rotation: Tensor) -> Tensor:
    """A plane given in the world, seen from the frame (position, rotation matrix).

    ``position (*batch, 3)`` m, ``rotation (*batch, 3, 3)``: frame axes in the world.
    """
    normal, offset = plane[..., :3], plane[..., 3:]
    normal_b = (rotation.mT @ normal[..., None])[..., 0]
    offset_b = offset - (normal * position).sum(-1, keepdim=True)
    return torch.cat((normal_b, offset_b), -1)


def sphere_distance(points: Tensor, size: Tensor) -> tuple[Tensor, Tensor]:
    """To a sphere about the origin; ``size (*batch, 3)`` begins with its radius, m."""
    distance, normal = length_and_direction(points, _z_axis(points))
    return distance - size[..., None, 0], normal


def capsule_distance(points: Tensor, size: Tensor) -> tuple[Tensor, Tensor]:
    """To a capsule along z; ``size (*batch, 3)``: radius, half the cylinder's length, m."""
    half = size[..., None, 1]
    along = points[..., 2]
    axis = along.clamp(-half, half)  # the closest point of the capsule's axis
    offset = torch.cat((points[..., :2], (along - axis)[..., None]), -1)
    x_axis = _z_axis(points).roll(1, -1)
    distance, normal = length_and_direction(offset, x_axis)
    return distance - size[..., None, 0], normal


def box_distance(points: Tensor, size: Tensor) -> tuple[Tensor, Tensor]:
    """To a box about the origin; ``size (*batch, 3)`` is half its lengths, m.

    Inside, the closest point lies on the nearest face.
    """
    half = size[..., None, :]
    beyond = points.abs() - half  # per axis: how far outside
    deepest = beyond.argmax(-1, keepdim=True)
    sign = torch.where(points < 0.0, -1.0, 1.0).to(points)
    face = torch.zeros_like(points).scatter(-1, deepest, sign.gather(-1, deepest))
    outside = sign * beyond.clamp_min(0.0)
    distance, normal = length_and_direction(outside, face)
    depth = beyond.gather(-1, deepest)[..., 0]
    return torch.where(depth > 0.0, distance, depth), normal


SHAPES: dict[int, Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]] = {
    int(mujoco.mjtGeom.mjGEOM_SPHERE): sphere_distance,
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): capsule_distance,
    int(mujoco.mjtGeom.mjGEOM_BOX): box_distance,
}
"""Shapes that MuJoCo's three size numbers say all of, by MuJoCo's geom type."""


def into_frame(
    points: Tensor, position: Tensor, rotation: Tensor, origin: Tensor, axes: Tensor
) -> tuple[Tensor, Tensor]:
    """Points of one frame as another frame sees them.

    The two frames' difference comes first, so that a robot far from the world's origin
    loses no digits to it.

    Args:
        points: ``(*batch, P, 3)``, m, in the frame (position, rotation).
        position: ``(*batch, 3)``, m, of the points' frame in the world.
        rotation: ``(*batch, 3, 3)``, axes of the points' frame in the world.
        origin: ``(*batch, 3)``, m, of the other frame in the world.
        axes: ``(*batch, 3, 3)``, axes of the other frame in the world.

    Returns:
        The points, and the rotation ``(*batch, 3, 3)`` that took them there: for a normal
        found there, ``normal @ turn`` is the normal in the points' frame.
    """
    turn = axes.mT @ rotation
    shift = (axes.mT @ (position - origin)[..., None]).mT
    return points @ turn.mT + shift, turn


def length_and_direction(vector: Tensor, fallback: Tensor) -> tuple[Tensor, Tensor]:
    """Length ``(*batch,)`` and unit vector ``(*batch, 3)``; ``fallback`` at zero length.

    Differentiable everywhere; no gradient passes through a vector of no length.
    """
    squared = (vector * vector).sum(-1, keepdim=True)
    is_zero = squared < ON_SURFACE**2
    length = torch.where(is_zero, torch.ones_like(squared), squared).sqrt()
    direction = torch.where(is_zero, fallback, vector / length)
    return torch.where(is_zero, squared, length)[..., 0], direction


def _z_axis(like: Tensor) -> Tensor:
    axis = torch.zeros_like(like)
    axis[..., 2] = 1.0
    return axis
