"""Silhouettes of geoms and lines on the ground: what a drawing needs of a shape.

Seen from far away every convex shape is the hull of a few of its points, and a round one
the hull of circles, whatever it is turned like.
"""

import mujoco
import numpy as np
from scipy.spatial import ConvexHull

from torchrl_nerd.evaluation.render.camera import Camera
from torchrl_nerd.evaluation.render.poser import MESH

SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX = (
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}"))
    for name in ("SPHERE", "CAPSULE", "ELLIPSOID", "CYLINDER", "BOX")
)
TURN = np.linspace(0.0, 2.0 * np.pi, 32, endpoint=False)
CIRCLE = np.stack((np.cos(TURN), np.sin(TURN)), -1)
GRID_LINES = 24  # to each side of the middle


Patch = tuple[np.ndarray, float]
"""Corners ``(n, 2)`` in the picture, m from its middle, and brightness in [0, 1]."""


def patches(
    model: mujoco.MjModel, data: mujoco.MjData, geom: int, camera: Camera, frame: int
) -> list[Patch]:
    """What is seen of a geom: of a box its near faces, of others the silhouette."""
    centre, turn = data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3)
    if model.geom_type[geom] == BOX:
        return _faces(centre, turn * model.geom_size[geom], camera, frame)
    points, radius = _skeleton(model, geom)
    flat = camera.project(centre + points @ turn.T, frame)
    if radius > 0.0:
        flat = (flat[:, None] + radius * CIRCLE).reshape(-1, 2)
    return [(flat[ConvexHull(flat, qhull_options="QJ").vertices], 1.0)]


def _faces(
    centre: np.ndarray, edges: np.ndarray, camera: Camera, frame: int
) -> list[Patch]:
    """Near faces of a box whose half edges are the columns of ``edges``."""
    seen = []
    for axis, sign in ((axis, sign) for axis in range(3) for sign in (-1.0, 1.0)):
        normal = sign * edges[:, axis]
        if normal @ camera.axes[2] >= 0.0:
            continue
        u, v = (edges[:, (axis + turn) % 3] for turn in (1, 2))
        loop = centre + normal + np.stack((-u - v, u - v, u + v, v - u))
        up = float(normal[2] / np.linalg.norm(normal))
        seen.append((camera.project(loop, frame), 0.85 + 0.15 * up))
    return seen


def _skeleton(model: mujoco.MjModel, geom: int) -> tuple[np.ndarray, float]:
    """Points in the geom's frame, and the radius of the ball rolled over them."""
    kind, size = int(model.geom_type[geom]), model.geom_size[geom]
    if kind == SPHERE:
        return np.zeros((1, 3)), float(size[0])
    if kind == CAPSULE:
        return np.array(((0.0, 0.0, -size[1]), (0.0, 0.0, size[1]))), float(size[0])
    if kind == CYLINDER:
        rings = [np.column_stack((size[0] * CIRCLE, np.full(32, z))) for z in size[[1]]]
        return np.concatenate((rings[0], rings[0] * (1.0, 1.0, -1.0))), 0.0
    if kind == ELLIPSOID:
        rings = np.stack(
            [
                np.column_stack((CIRCLE * np.cos(b), np.full(32, np.sin(b))))
                for b in TURN
            ]
        )
        return rings.reshape(-1, 3) * size, 0.0
    if kind == MESH:
        mesh = model.geom_dataid[geom]
        first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        return model.mesh_vert[first : first + count].astype(float), 0.0
    return np.zeros((1, 3)), float(model.geom_rbound[geom])


def profile(
    data: mujoco.MjData, plane: int, camera: Camera, frame: int
) -> np.ndarray | None:
    """Where a plane cuts the upright plane that is looked at: ``(2, 2)`` m, left to right.

    None where they are parallel.
    """
    normal, lookat = data.geom_xmat[plane].reshape(3, 3)[:, 2], camera.lookat[frame]
    right, up = camera.axes[:2] @ normal
    depth = normal @ (data.geom_xpos[plane] - lookat)
    if abs(up) < 1e-3:
        return None
    x = np.array((-1.0, 1.0)) * GRID_LINES * camera.half_height
    return np.stack((x, (depth - right * x) / up), -1)


def grid(
    data: mujoco.MjData, plane: int, lookat: np.ndarray, spacing: float
) -> np.ndarray:
    """Lines on a plane about a point, standing still in the world, ``(n, 2, 3)`` m.

    Args:
        data: after kinematics.
        plane: the geom.
        lookat: ``(3,)``; the lines lie about the point of the plane nearest to it.
        spacing: between them, m.
    """
    origin, turn = data.geom_xpos[plane], data.geom_xmat[plane].reshape(3, 3)
    middle = np.round((lookat - origin) @ turn[:, :2] / spacing)
    ticks = np.arange(-GRID_LINES, GRID_LINES + 1)
    ends = np.array((-GRID_LINES, GRID_LINES))
    along = np.stack(np.broadcast_arrays(ticks[:, None], ends), -1)
    lines = spacing * (middle + np.concatenate((along, along[..., ::-1])))
    return origin + lines @ turn[:, :2].T
