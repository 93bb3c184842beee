"""Closest point, normal and distance of points to ground surfaces, batched.

One function a surface. Each takes points ``(*batch, P, 3)`` and the surface's parameters
``(*batch, K)``, both in one frame, and returns the signed distance ``(*batch, P)`` (m,
negative inside) and the outward unit normal ``(*batch, P, 3)``. The closest point is
``point - distance * normal``.
"""

import torch
from torch import Tensor

PLANE_PARAMETERS = 4
"""Unit normal (3) and offset: ``normal . x = offset``."""


def plane_distance(points: Tensor, plane: Tensor) -> tuple[Tensor, Tensor]:
    """Signed distance to a plane (unit normal, offset in m), and its normal."""
    normal, offset = plane[..., None, :3], plane[..., None, 3]
    distance = (points * normal).sum(-1) - offset
    return distance, normal.expand_as(points)


def plane_in_frame(plane: Tensor, position: Tensor, rotation: Tensor) -> Tensor:
    """A plane given in the world, seen from the frame (position, rotation matrix).

    ``position (*batch, 3)`` m, ``rotation (*batch, 3, 3)``: frame axes in the world.
    """
    normal, offset = plane[..., :3], plane[..., 3:]
    normal_b = (rotation.mT @ normal[..., None])[..., 0]
    offset_b = offset - (normal * position).sum(-1, keepdim=True)
    return torch.cat((normal_b, offset_b), -1)
