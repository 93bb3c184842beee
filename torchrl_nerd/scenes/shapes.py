"""Shapes as convex hulls of a few balls: what a contact point with a radius stands for.

Over a plane only the convex hull of a shape counts. A sphere, a capsule and a box are hulls
of one, two and eight balls. A cylinder, an ellipsoid and a mesh (MuJoCo collides its convex
hull) are hulls of many, of which `thin` keeps those that the others reach farthest beyond.
Every ball lies inside its shape, so the hull of some is never larger than the shape.
"""

from itertools import product
from math import cos, pi

import mujoco
import numpy as np
from scipy.optimize import nnls

from torchrl_nerd.geometry.rotations import quat_matrix

RIM = 32  # points around a cylinder's rim before thinning
LATITUDES = 12  # of an ellipsoid's balls, over a quarter of a turn
EXACT = ("sphere", "capsule", "box")  # hulls of few balls
SUM = 1e3  # weight of "the shares add up to one", beside a length of one


def geom_kind(model: mujoco.MjModel, geom: int) -> str:
    """MuJoCo's word for a geom's type, such as ``capsule``."""
    return mujoco.mjtGeom(model.geom_type[geom]).name.removeprefix("mjGEOM_").lower()


def shape_balls(
    model: mujoco.MjModel, geom: int
) -> tuple[np.ndarray, np.ndarray, float]:
    """Balls whose convex hull is a geom.

    | shape | balls | error |
    |---|---|---|
    | sphere, capsule, box | its centre, cap centres, corners | 0 |
    | mesh | vertices of its convex hull, of radius 0 | 0 |
    | cylinder of radius R | 32 points on either rim | R (1 - cos(pi / 32)) |
    | ellipsoid, half-lengths a >= b >= c | the largest balls inside that touch it where its
      normal is n, for normals at most d from one of them | (a^2/c - c^2/a) (1 - cos d) |

    Returns:
        Centres ``(n, 3)``, m, body frame; radii ``(n,)``, m; how far the shape reaches
        beyond the hull at most, m.
    """
    size, kind = model.geom_size[geom], geom_kind(model, geom)
    radius, error = 0.0, 0.0
    if kind == "sphere":
        local, radius = np.zeros((1, 3)), size[0]
    elif kind == "capsule":
        local, radius = np.array([[0, 0, size[1]], [0, 0, -size[1]]]), size[0]
    elif kind == "box":
        local = np.array(list(product((-1, 1), repeat=3))) * size
    elif kind == "cylinder":
        angle = 2.0 * pi * np.arange(RIM) / RIM
        rim = size[0] * np.stack((np.cos(angle), np.sin(angle)), 1)
        local = np.concatenate([np.insert(rim, 2, z, 1) for z in (size[1], -size[1])])
        error = size[0] * (1.0 - cos(pi / RIM))
    elif kind == "ellipsoid":
        local, radius, error = _ellipsoid(size)
    elif kind == "mesh":
        local = _hull(model, int(model.geom_dataid[geom]))
    else:
        raise ValueError(f"expected a shape that is convex, got a {kind}")
    turn = quat_matrix(model.geom_quat[geom])
    points = local @ turn.T + model.geom_pos[geom]
    return points, np.broadcast_to(radius, len(points)).astype(float), float(error)


def thin(
    points: np.ndarray,
    radii: np.ndarray,
    groups: np.ndarray,
    kept: np.ndarray,
    tolerance: float,
    most: int,
) -> tuple[np.ndarray, float]:
    """Which balls to keep so that each group's hull stays nearly the same.

    Again and again the ball that reaches farthest beyond its group's hull is added, until
    none reaches farther than the tolerance (m) or there are ``most``; one for every group
    at least. Of the balls at ``points (n, 3)``, ``groups (n,)`` says which body each is on,
    and ``kept (n,)`` which to keep in any case.

    Returns:
        Which are kept, ``(n,)`` bool, and an upper bound on how far a dropped one reaches
        beyond the hull of those kept, m.
    """
    kept, beyond = kept.copy(), np.full(len(points), np.inf)
    for group in set(groups.tolist()):
        (mine,) = np.nonzero(groups == group)
        if not kept[mine].any():
            away = points[mine] - points[mine].mean(0)
            kept[mine[np.linalg.norm(away, axis=1).argmax()]] = True
    while True:
        beyond[kept], before = 0.0, np.inf
        while beyond[i := int(beyond.argmax())] > 0.0:
            before, mine = beyond[i], kept & (groups == groups[i])
            beyond[i] = _beyond(points[i], radii[i], points[mine], radii[mine])
            # more balls only make these smaller: the largest, looked at again, is it
            if beyond[i] >= min(before, beyond.max()):
                break
        if beyond[i] <= tolerance or kept.sum() >= most:
            return kept, float(beyond[i])
        kept[i] = True


def _beyond(
    point: np.ndarray, radius: float, points: np.ndarray, radii: np.ndarray
) -> float:
    """How far a ball reaches beyond the convex hull of others, m; an upper bound.

    With shares w >= 0 that add up to one, the ball of centre sum w p and radius sum w r
    lies in the hull, and so |p0 - sum w p| + r0 - sum w r is such a bound.
    """
    size = np.abs(points - point).max() + 1e-12
    away = (points - point).T / size
    rows = np.vstack((away, radii / size, np.full(len(points), SUM)))
    aim = np.array([0.0, 0.0, 0.0, radius / size, SUM])
    shares, _ = nnls(rows, aim, maxiter=100 * len(points))
    shares /= shares.sum()
    away = np.linalg.norm(shares @ points - point)
    return float(max(0.0, away + radius - shares @ radii))


def _ellipsoid(size: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Inscribed balls of radius c^2 / |D n|, centre (D^2 - c^2) n / |D n| at normal n.

    D holds the half-lengths, c is the smallest; n and its mirror image share a ball.
    """
    axis = int(size.argmin())
    step = 0.5 * pi / LATITUDES
    theta = np.repeat(step * np.arange(LATITUDES + 1), 4 * LATITUDES)
    phi = np.tile(step * np.arange(4 * LATITUDES), LATITUDES + 1)
    normal = np.stack((np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi)), 1)
    normal = np.insert(normal, axis, np.cos(theta), 1)
    stretch, least, most = size * normal, size.min(), size.max()
    length = np.linalg.norm(stretch, axis=1)
    center = (size**2 - least**2) * normal / length[:, None]
    off = 2.0**-0.5 * step  # of a normal from the nearest one at most
    error = (most**2 / least - least**2 / most) * (1.0 - cos(off))
    return center, least**2 / length, error


def _hull(model: mujoco.MjModel, mesh: int) -> np.ndarray:
    """Vertices of a mesh's convex hull ``(n, 3)``, m, in the geom's frame."""
    start, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
    vertices = model.mesh_vert[start : start + count].astype(float)
    at = int(model.mesh_graphadr[mesh])
    if at < 0:  # no graph: the mesh is its own hull
        return np.unique(vertices, axis=0)
    number = int(model.mesh_graph[at])  # then faces, edge addresses, vertex ids
    return vertices[model.mesh_graph[at + 2 + number : at + 2 + 2 * number]]
