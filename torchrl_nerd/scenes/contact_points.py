"""The points of a robot that can touch the ground.

As in the paper (section 3.2; facts of the reference code): a sphere's centre, a capsule's
two cap centres, a box's eight corners. Cylinders, ellipsoids and meshes have points too,
see `shapes`: body by body those that matter most over a plane, up to `TOLERANCE` or a
number that the scene allows. Points that always coincide are merged, points that no joint
can move are dropped: the ground cannot do work on them, but for friction at the rim of a
cap that turns on the spot.
"""

from dataclasses import dataclass

import mujoco
import numpy as np

from torchrl_nerd.geometry.base import Base
from torchrl_nerd.scenes.shapes import EXACT, geom_kind, shape_balls, thin

TOLERANCE = 0.002  # m: how far a shape may reach beyond its contact points
MAX_POINTS = 64  # of all shapes, where nobody says
PLANE, BOX, HEIGHT_FIELD = (
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{kind}"))
    for kind in ("PLANE", "BOX", "HFIELD")
)
MARGIN_PER_RADIUS = 4.0  # paper, appendix A: xi = max(4 thickness, 0.1 m)
MIN_MARGIN = 0.1  # m

NO_CONTACT = (
    mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
)


@dataclass(frozen=True)
class ContactPoints:
    """Contact points after merging."""

    bodies: list[int]  # body id of each point
    positions: np.ndarray  # (P, 3), m, body frame
    radii: np.ndarray  # (P,), m: a point at this distance from the ground touches it
    margins: np.ndarray  # (P,), m: xi, distance beyond which a point has no features
    stands_for: list[int]  # of every point of the shapes: which one here, -1 for none
    error: float = 0.0  # m: how far a shape reaches beyond its points at most
    thinned: int = 0  # points of the shapes that were left out for few

    def __len__(self) -> int:
        return len(self.bodies)

    @property
    def merged(self) -> np.ndarray:
        """Which of the shapes' points each stands for, ``(P, len(stands_for))``, bool."""
        return np.arange(len(self))[:, None] == self.stands_for


def contact_points(
    model: mujoco.MjModel, base: Base, most: int = MAX_POINTS
) -> ContactPoints:
    """Find the contact points of the robot in a compiled model, about ``most`` at most.

    Raises:
        ValueError: a shape that can touch the ground is none of `shape_balls`'.
    """
    bodies, positions, radii, error, thinned = shape_points(model, most)
    leaders = _leaders(model, base, bodies, positions, radii)
    kept = sorted(set(leaders) - {-1})
    return ContactPoints(
        bodies=[bodies[i] for i in kept],
        positions=positions[kept],
        radii=radii[kept],
        margins=np.maximum(MARGIN_PER_RADIUS * radii[kept], MIN_MARGIN),
        stands_for=[kept.index(i) if i >= 0 else -1 for i in leaders],
        error=error,
        thinned=thinned,
    )


def shape_points(
    model: mujoco.MjModel, most: int = MAX_POINTS
) -> tuple[list[int], np.ndarray, np.ndarray, float, int]:
    """The points of every shape that can touch the ground, none merged.

    Body ids, positions ``(N, 3)`` (m, body frame), radii ``(N,)`` (m), and ``error`` and
    ``thinned`` of `ContactPoints`. A robot of ``most`` points of spheres, capsules and
    boxes keeps them all; of another one the spheres' remain and those that `thin` keeps.
    """
    geoms, error = touching_geoms(model), 0.0
    parts: list[tuple[np.ndarray, np.ndarray]] = [(np.zeros((0, 3)), np.zeros(0))]
    for geom in geoms:
        points, radius, beyond = shape_balls(model, geom)
        parts.append((points, radius))
        error = max(error, beyond)
    counts = np.array([len(radius) for _, radius in parts[1:]], int)
    positions, radii = (np.concatenate(x) for x in zip(*parts, strict=True))
    bodies = np.repeat(model.geom_bodyid[geoms], counts)
    is_exact = np.array([geom_kind(model, geom) in EXACT for geom in geoms], bool)
    kept = np.repeat(is_exact, counts)
    if not kept.all() or len(kept) > most:
        single = np.repeat(counts == 1, counts)
        kept, more = thin(positions, radii, bodies, single, TOLERANCE, most)
        error += more
    thinned = int((~kept).sum())
    return bodies[kept].tolist(), positions[kept], radii[kept], error, thinned


def touching_geoms(model: mujoco.MjModel) -> list[int]:
    """Moving shapes that can touch a surface of `terrain_geoms`."""
    touches = collision_filter(model)[:, terrain_geoms(model)].any(1)
    return np.flatnonzero(_is_moving(model) & touches).tolist()


def ground_geoms(model: mujoco.MjModel) -> list[int]:
    """Static or mocap shapes that something moving can touch."""
    weld = model.body_weldid[model.geom_bodyid]
    is_ground = (weld == 0) | (model.body_mocapid[weld] >= 0)
    touches = collision_filter(model)[:, _is_moving(model)].any(1)
    return np.flatnonzero(is_ground & touches).tolist()


def terrain_geoms(model: mujoco.MjModel) -> list[int]:
    """Of `ground_geoms` those to which the distance of a point is known."""
    is_known = np.isin(model.geom_type, (PLANE, BOX, HEIGHT_FIELD))
    return [geom for geom in ground_geoms(model) if is_known[geom]]


def own_contacts(model: mujoco.MjModel) -> list[tuple[int, int]]:
    """Pairs of the robot's own shapes between which MuJoCo detects contact."""
    moving = _is_moving(model)
    pairs = np.argwhere(np.triu(collision_filter(model) & moving[:, None] & moving))
    return [(low, high) for low, high in pairs.tolist()]


def collision_filter(model: mujoco.MjModel) -> np.ndarray:
    """Between which geoms, one of which moves, MuJoCo detects contact, ``(n, n)`` bool.

    Explicit pairs always. Else not those of one body, of a body and its parent (but for
    the world), or that the model excludes, and only those whose bits say so. Source:
    https://mujoco.readthedocs.io/en/stable/computation/index.html#selection
    """
    if model.opt.disableflags & NO_CONTACT:
        return np.zeros((model.ngeom, model.ngeom), bool)
    body = model.geom_bodyid
    top, parent = model.body_weldid[body], model.body_weldid[model.body_parentid]
    is_child = (parent[top] == top[:, None]) & (top[:, None] > 0)
    if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT:
        is_child[:] = False
    low, high = np.minimum(body, body[:, None]), np.maximum(body, body[:, None])
    is_excluded = np.isin((low << 16) + high, model.exclude_signature)
    is_asked = (model.geom_contype & model.geom_conaffinity[:, None]) != 0
    is_pair = (is_asked | is_asked.T) & (top != top[:, None])
    is_pair &= ~(is_child | is_child.T | is_excluded)
    is_pair[model.pair_geom1, model.pair_geom2] = True
    return is_pair | is_pair.T


def body_label(model: mujoco.MjModel, body: int) -> str:
    """A body's name; ``body 3`` where it has none."""
    return model.body(body).name or f"body {body}"


def _is_moving(model: mujoco.MjModel) -> np.ndarray:
    return model.body_dofnum[model.body_weldid[model.geom_bodyid]] > 0


def _leaders(
    model: mujoco.MjModel,
    base: Base,
    bodies: list[int],
    positions: np.ndarray,
    radii: np.ndarray,
) -> list[int]:
    """Of each point, the first one that it follows everywhere; -1 where none moves it."""
    rng, data = np.random.default_rng(0), mujoco.MjData(model)
    tracks = []
    for _ in range(4):
        mujoco.mj_integratePos(model, data.qpos, rng.normal(size=model.nv), 1.0)
        mujoco.mj_kinematics(model, data)
        turns = data.xmat[bodies].reshape(-1, 3, 3)
        tracks.append(data.xpos[bodies] + (turns @ positions[..., None])[..., 0])
    track = np.stack(tracks, 1)  # (P, poses, 3)
    apart = abs(track[:, None] - track).max((2, 3))  # (P, P), m
    twins = (apart < 1e-9) & (radii[:, None] == radii)
    # the first twin, which may be the point itself
    leaders = np.array([row.argmax() for row in twins], int)
    if not base.is_floating:
        leaders[np.ptp(track, 1).max(1) < 1e-9] = -1
    return leaders.tolist()
