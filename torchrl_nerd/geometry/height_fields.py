"""Signed distance and normal of points to a height field, batched.

MuJoCo's height field is a grid of heights over x and y whose cells are each cut in two
along the diagonal from (row r, column c) to (r + 1, c + 1); see ``mjc_ConvexHField`` in
its ``engine_collision_convex.c``. The closest point of such a triangulation lies on a
face, an edge or a vertex. A face holds it only if the foot of the perpendicular lies
above the face's right triangle in the x-y plane, which is what makes this cheap.
"""

import torch
from torch import Tensor

from torchrl_nerd.geometry.surfaces import length_and_direction

Vector = tuple[Tensor, Tensor, Tensor]


def height_field_distance(
    points: Tensor, heights: Tensor, half_x: float, half_y: float, reach: float
) -> tuple[Tensor, Tensor]:
    """Signed distance to a height field and its outward normal.

    Only cells within ``reach`` of a point (horizontally) are looked at. The distance is
    exact up to ``reach``; for points farther away it is at least ``reach`` and at most
    the distance to the surface right above or below. A point is inside (negative
    distance) where it lies below the surface, at any depth; beside the field nothing is
    inside: the solid base and the sides that MuJoCo gives a height field are no ground.

    Args:
        points: ``(*batch, P, 3)``, m, in the field's frame.
        heights: ``(rows, columns)``, m; rows along y, columns along x.
        half_x: half the field's length along x, m.
        half_y: half the field's length along y, m.
        reach: distance up to which the result is exact, m.

    Returns:
        distance ``(*batch, P)``, m, and unit normal ``(*batch, P, 3)``.
    """
    rows, columns = heights.shape
    dx, dy = 2.0 * half_x / (columns - 1), 2.0 * half_y / (rows - 1)
    column, first_column, wide = _window(points[..., 0], half_x, dx, columns, reach)
    row, first_row, high = _window(points[..., 1], half_y, dy, rows, reach)
    at_column = first_column[..., None] + torch.arange(wide + 1, device=points.device)
    at_row = first_row[..., None] + torch.arange(high + 1, device=points.device)
    near = heights[at_row[..., :, None], at_column[..., None, :]]
    # vertices of the window as seen from the point, each (*batch, P, high + 1, wide + 1)
    x = (dx * at_column - half_x - points[..., :1])[..., None, :].expand_as(near)
    y = (dy * at_row - half_y - points[..., 1:2])[..., :, None].expand_as(near)
    z = near - points[..., 2, None, None]
    closest = _closest((x, y, z), dx, dy)
    rise, upward = _straight_down(points, heights, column, row, half_x, half_y)
    sign = torch.where(rise < 0.0, -1.0, 1.0).to(points)
    distance, normal = length_and_direction(-sign[..., None] * closest, upward)
    return sign * distance, normal


def _window(
    along: Tensor, half: float, step: float, count: int, reach: float
) -> tuple[Tensor, Tensor, int]:
    """The point's cell, the first cell of the window about it, and its cells, one axis.

    The window holds every cell within ``reach``; near the border it is moved inwards.
    """
    cell = ((along.detach() + half) / step).floor().nan_to_num(0.0)
    cell = cell.clamp(0, count - 2).long()
    margin = int(reach / step) + 1
    width = min(2 * margin + 1, count - 1)
    return cell, (cell - margin).clamp(0, count - 1 - width), width


def _closest(vertices: Vector, dx: float, dy: float) -> Tensor:
    """From the point to the closest point of the triangulated window, ``(*batch, P, 3)``.

    ``vertices``: x, y, z ``(*batch, P, R, C)``, m, relative to the point.
    """
    origin, right, up, across = (
        tuple(part[..., rows, columns] for part in vertices)
        for rows in (slice(None, -1), slice(1, None))
        for columns in (slice(None, -1), slice(1, None))
    )
    along_x = tuple(part[..., :-1] for part in vertices)
    along_y = tuple(part[..., :-1, :] for part in vertices)
    end_x = tuple(part[..., 1:] for part in vertices)
    end_y = tuple(part[..., 1:, :] for part in vertices)
    candidates = [
        _on_segment(along_x, end_x[2] - along_x[2], dx, 0.0),
        _on_segment(along_y, end_y[2] - along_y[2], 0.0, dy),
        _on_segment(origin, across[2] - origin[2], dx, dy),
        # z(u, v) = z0 + slope_x u + slope_y v over either triangle
        _on_face(
            origin, right[2] - origin[2], across[2] - right[2], dx, dy, below=True
        ),
        _on_face(origin, across[2] - up[2], up[2] - origin[2], dx, dy, below=False),
    ]
    offset = torch.cat([torch.stack(c, -1).flatten(-3, -2) for c in candidates], -2)
    best = (offset.detach() ** 2).sum(-1).argmin(-1)
    index = best[..., None, None].expand(*best.shape, 1, 3)
    return offset.gather(-2, index)[..., 0, :]


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
    return tuple(torch.where(is_on, part, far) for part in (foot_x, foot_y, -share))


def _straight_down(
    points: Tensor,
    heights: Tensor,
    column: Tensor,
    row: Tensor,
    half_x: float,
    half_y: float,
) -> tuple[Tensor, Tensor]:
    """Height over the surface (m, positive beside the field), and the face's normal."""
    rows, columns = heights.shape
    dx, dy = 2.0 * half_x / (columns - 1), 2.0 * half_y / (rows - 1)
    u = (points[..., 0] + half_x) / dx - column
    v = (points[..., 1] + half_y) / dy - row
    origin, across = heights[row, column], heights[row + 1, column + 1]
    right, up = heights[row, column + 1], heights[row + 1, column]
    is_below = v <= u  # the diagonal, see `_on_face`
    rise_x = torch.where(is_below, right - origin, across - up)
    rise_y = torch.where(is_below, across - right, up - origin)
    above = points[..., 2] - origin - rise_x * u - rise_y * v
    is_over = (u >= 0.0) & (u <= 1.0) & (v >= 0.0) & (v <= 1.0)
    normal = torch.stack((-rise_x / dx, -rise_y / dy, torch.ones_like(u)), -1)
    normal = normal / torch.linalg.vector_norm(normal, dim=-1, keepdim=True)
    return torch.where(is_over, above, above.abs()), normal
