"""Signed distance and normal of points to ground surfaces, batched.

Every function takes points ``(*batch, P, 3)`` and returns the signed distance
``(*batch, P)`` (m, negative inside) and the outward unit normal ``(*batch, P, 3)``, both
at the closest point of the surface, which is ``point - distance * normal``. A plane is
given by its equation in the points' frame. Boxes and height fields stand in a frame of
their own as MuJoCo's geoms do, with MuJoCo's sizes; `into_frame` takes points there.

A height field is a grid of heights over x and y whose cells are each cut in two along the
diagonal from (row r, column c) to (r + 1, c + 1); see ``mjc_ConvexHField`` in MuJoCo's
``engine_collision_convex.c``. The closest point of such a triangulation lies on a face, an
edge or a vertex. A face holds it only if the foot of the perpendicular lies above the
face's right triangle in the x-y plane.
"""

import torch
from torch import Tensor

PLANE_PARAMETERS = 4
"""Unit normal (3) and offset: ``normal . x = offset``."""

ON_SURFACE = 1e-12  # m: closer to a centre or an edge, the direction is rounding

Vector = tuple[Tensor, Tensor, Tensor]


def plane_distance(points: Tensor, plane: Tensor) -> tuple[Tensor, Tensor]:
    """To a plane ``(*batch, 4)``: unit normal, offset in m."""
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


def box_distance(points: Tensor, size: Tensor) -> tuple[Tensor, Tensor]:
    """To a box about the origin; ``size (3,)`` is half its lengths, m.

    Inside, the closest point lies on the nearest face.
    """
    beyond = points.abs() - size  # per axis: how far outside
    deepest = beyond.argmax(-1, keepdim=True)
    sign = torch.where(points < 0.0, -1.0, 1.0).to(points)
    face = torch.zeros_like(points).scatter(-1, deepest, sign.gather(-1, deepest))
    outside = sign * beyond.clamp_min(0.0)
    distance, normal = _length_and_direction(outside, face)
    depth = beyond.gather(-1, deepest)[..., 0]  # (*batch, P)
    return torch.where(depth > 0.0, distance, depth), normal


def into_frame(
    points: Tensor, position: Tensor, rotation: Tensor, origin: Tensor, axes: Tensor
) -> tuple[Tensor, Tensor]:
    """Points of the frame (position, rotation) as the frame (origin, axes) sees them.

    Both frames are given in the world, ``(*batch, 3)``, m, and ``(*batch, 3, 3)``. Their
    difference comes first, so that a robot far from the world's origin loses no digits.

    Returns:
        The points, and the rotation ``(*batch, 3, 3)`` that took them there: for a normal
        found there, ``normal @ turn`` is the normal in the points' frame.
    """
    turn = axes.mT @ rotation
    shift = (axes.mT @ (position - origin)[..., None]).mT  # (*batch, 1, 3)
    return points @ turn.mT + shift, turn


def height_field_distance(
    points: Tensor, heights: Tensor, half_x: float, half_y: float, reach: float
) -> tuple[Tensor, Tensor]:
    """To a height field.

    The distance is exact up to ``reach``; for points farther away it is at least ``reach``
    and at most the distance to the surface right above or below. A point is inside
    (negative distance) where it lies below the surface, at any depth. Beside the field
    nothing is inside: the solid base and the sides that MuJoCo gives it are no ground.

    ``heights (rows, columns)``, m: rows along y over ``2 half_y`` m, columns along x over
    ``2 half_x`` m. Cells within ``reach`` of a point (horizontally) are looked at.
    """
    rows, columns = heights.shape
    dx, dy = 2.0 * half_x / (columns - 1), 2.0 * half_y / (rows - 1)
    column, at_column = _window(points[..., 0], half_x, dx, columns, reach)
    row, at_row = _window(points[..., 1], half_y, dy, rows, reach)
    near = heights[at_row[..., :, None], at_column[..., None, :]]  # (*batch, P, R, C)
    # vertices of the window as seen from the point
    x = dx * at_column.to(points) - half_x - points[..., :1]
    y = dy * at_row.to(points) - half_y - points[..., 1:2]
    z = near - points[..., 2, None, None]
    x, y = x[..., None, :].expand_as(near), y[..., :, None].expand_as(near)
    closest = _closest((x, y, z), dx, dy)
    u = (points[..., 0] + half_x) / dx - column
    v = (points[..., 1] + half_y) / dy - row
    # right above or below the point: height over the surface and the face's normal
    origin, across = heights[row, column], heights[row + 1, column + 1]
    right, up = heights[row, column + 1], heights[row + 1, column]
    is_below = v <= u  # the diagonal, see `_on_face`
    rise_x = torch.where(is_below, right - origin, across - up)
    rise_y = torch.where(is_below, across - right, up - origin)
    above = points[..., 2] - origin - rise_x * u - rise_y * v
    is_over = (u >= 0.0) & (u <= 1.0) & (v >= 0.0) & (v <= 1.0)
    upward = torch.stack((-rise_x / dx, -rise_y / dy, torch.ones_like(u)), -1)
    upward = upward / torch.linalg.vector_norm(upward, dim=-1, keepdim=True)
    sign = torch.where(is_over & (above < 0.0), -1.0, 1.0).to(points)
    distance, normal = _length_and_direction(-sign[..., None] * closest, upward)
    return sign * distance, normal


def _window(
    along: Tensor, half: float, step: float, count: int, reach: float
) -> tuple[Tensor, Tensor]:
    """Along one axis: the point's cell, and the vertices ``(*batch, P, W)`` about it.

    Between them is every cell within ``reach``; near the border they are moved inwards.
    """
    place = ((along.detach() + half) / step).nan_to_num(0.0)
    cell = place.floor().clamp(0, count - 2)
    width = min(int(2.0 * reach / step) + 2, count - 1)
    first = torch.minimum((place - reach / step).floor(), cell)
    first = first.clamp(0, count - 1 - width).long()
    return cell.long(), first[..., None] + torch.arange(width + 1, device=along.device)


def _closest(vertices: Vector, dx: float, dy: float) -> Tensor:
    """From the point to the closest point of the triangulated window, ``(*batch, P, 3)``.

    ``vertices``: x, y, z ``(*batch, P, R, C)``, m, relative to the point.
    """
    first, whole = slice(None, -1), slice(None)
    origin, z = _cut(vertices, first, first), vertices[2]
    right, up, across = z[..., :-1, 1:], z[..., 1:, :-1], z[..., 1:, 1:]
    candidates = [
        _on_segment(_cut(vertices, whole, first), z.diff(dim=-1), dx, 0.0),
        _on_segment(_cut(vertices, first, whole), z.diff(dim=-2), 0.0, dy),
        _on_segment(origin, across - origin[2], dx, dy),
        # z(u, v) = z0 + rise_x u + rise_y v over either triangle
        _on_face(origin, right - origin[2], across - right, dx, dy, below=True),
        _on_face(origin, across - up, up - origin[2], dx, dy, below=False),
    ]
    offset = torch.stack([_shortest(candidate) for candidate in candidates], -2)
    best = (offset.detach() ** 2).sum(-1).argmin(-1)  # (*batch, P)
    index = best[..., None, None].expand(*best.shape, 1, 3)
    return offset.gather(-2, index)[..., 0, :]


def _cut(vertices: Vector, rows: slice, columns: slice) -> Vector:
    return tuple(part[..., rows, columns] for part in vertices)  # pyright: ignore


def _shortest(vectors: Vector) -> Tensor:
    """The shortest of each point's vectors, ``(*batch, P, R, C) -> (*batch, P, 3)``."""
    x, y, z = (part.flatten(-2) for part in vectors)
    best = (x * x + y * y + z * z).detach().argmin(-1, keepdim=True)
    return torch.cat([part.gather(-1, best) for part in (x, y, z)], -1)


def _on_segment(start: Vector, rise: Tensor, dx: float, dy: float) -> Vector:
    """Closest point of the segments from ``start`` to ``start + (dx, dy, rise)``."""
    x, y, z = start
    share = -(x * dx + y * dy + z * rise) / (dx * dx + dy * dy + rise * rise)
    share = share.clamp(0.0, 1.0)
    return x + share * dx, y + share * dy, z + share * rise


def _on_face(
    origin: Vector, rise_x: Tensor, rise_y: Tensor, dx: float, dy: float, below: bool
) -> Vector:
    """Foot of the perpendicular on one triangle of each cell; infinite beside it.

    ``rise_x``, ``rise_y``: m that the face's plane rises over a whole cell. ``below``
    names the triangle below the diagonal, u >= v with (u, v) in the unit square.
    """
    x, y, z = origin
    slope_x, slope_y = rise_x / dx, rise_y / dy
    above = slope_x * x + slope_y * y - z  # of the point over the plane, vertically
    share = above / (1.0 + slope_x**2 + slope_y**2)
    foot_x, foot_y = share * slope_x, share * slope_y
    u, v = (foot_x - x) / dx, (foot_y - y) / dy
    low, high = (v, u) if below else (u, v)
    is_on = (low >= 0.0) & (low <= high) & (high <= 1.0)
    far = torch.full_like(z, torch.inf)
    foot = foot_x, foot_y, -share
    return tuple(torch.where(is_on, part, far) for part in foot)  # pyright: ignore


def _length_and_direction(vector: Tensor, fallback: Tensor) -> tuple[Tensor, Tensor]:
    """Length ``(*batch,)`` and unit vector ``(*batch, 3)``; ``fallback`` at zero length.

    Differentiable everywhere; no gradient passes through a vector of no length.
    """
    squared = (vector * vector).sum(-1, keepdim=True)
    is_zero = squared < ON_SURFACE**2
    length = torch.where(is_zero, torch.ones_like(squared), squared).sqrt()
    direction = torch.where(is_zero, fallback, vector / length)
    return torch.where(is_zero, squared, length)[..., 0], direction
