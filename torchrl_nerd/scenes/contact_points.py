"""The points of a robot that can touch the ground.

As in the paper (section 3.2; facts of the reference code): a sphere's centre, a capsule's
two cap centres, a box's eight corners. Points that always coincide are merged, points
that no joint can move are dropped: the ground cannot do work on them, but for friction at
the rim of a cap that turns on the spot.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations, product

import mujoco
import numpy as np

from torchrl_nerd.geometry.base import Base
from torchrl_nerd.geometry.rotations import quat_matrix

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

    def __len__(self) -> int:
        return len(self.bodies)

    @property
    def merged(self) -> np.ndarray:
        """Which of the shapes' points each stands for, ``(P, count_found)``, bool."""
        return np.arange(len(self))[:, None] == self.stands_for

    @property
    def count_found(self) -> int:
        """How many the shapes have before merging and dropping."""
        return len(self.stands_for)


def contact_points(model: mujoco.MjModel, base: Base) -> ContactPoints:
    """Find the contact points of the robot in a compiled model.

    Raises:
        ValueError: a shape that can touch the ground is none of sphere, capsule, box.
    """
    bodies, positions, radii = shape_points(model)
    leaders = _leaders(model, base, bodies, positions, radii)
    kept = sorted(set(leaders) - {-1})
    return ContactPoints(
        bodies=[bodies[i] for i in kept],
        positions=positions[kept],
        radii=radii[kept],
        margins=np.maximum(MARGIN_PER_RADIUS * radii[kept], MIN_MARGIN),
        stands_for=[kept.index(i) if i >= 0 else -1 for i in leaders],
    )


def shape_points(model: mujoco.MjModel) -> tuple[list[int], np.ndarray, np.ndarray]:
    """Every point of every shape that can touch the ground, none merged.

    Body ids, positions ``(N, 3)`` (m, body frame) and radii ``(N,)`` (m). Raises
    ValueError where a shape is none of sphere, capsule, box.
    """
    bodies, positions, radii = [], [], []
    grounds, is_pair = ground_geoms(model), collision_filter(model)
    for geom in _moving_geoms(model):
        if any(is_pair(geom, ground) for ground in grounds):
            points, radius = _points_of(model, geom)
            bodies += [int(model.geom_bodyid[geom])] * len(points)
            positions += list(points)
            radii += [radius] * len(points)
    return bodies, np.array(positions).reshape(-1, 3), np.array(radii)


def ground_geoms(model: mujoco.MjModel) -> list[int]:
    """Static or mocap shapes that something moving can touch."""
    if model.opt.disableflags & NO_CONTACT:
        return []
    moving, weld = _moving_geoms(model), model.body_weldid[model.geom_bodyid]
    is_pair = collision_filter(model)
    is_ground = (weld == 0) | (model.body_mocapid[weld] >= 0)
    return [
        geom
        for geom in np.flatnonzero(is_ground).tolist()
        if any(is_pair(geom, other) for other in moving)
    ]


def own_contacts(model: mujoco.MjModel) -> list[tuple[int, int]]:
    """Pairs of the robot's own shapes between which MuJoCo detects contact."""
    if model.opt.disableflags & NO_CONTACT:
        return []
    is_pair = collision_filter(model)
    return [pair for pair in combinations(_moving_geoms(model), 2) if is_pair(*pair)]


def collision_filter(model: mujoco.MjModel) -> Callable[[int, int], bool]:
    """Whether MuJoCo looks for contact between two geoms, one of which moves.

    Explicit pairs always. Else not those of one body, of a body and its parent (but for
    the world), or that the model excludes, and only those whose bits say so. Source:
    https://mujoco.readthedocs.io/en/stable/computation/index.html#selection
    """
    keep_parents = model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT
    weld, excluded = model.body_weldid, set(model.exclude_signature.tolist())
    ends = zip(model.pair_geom1.tolist(), model.pair_geom2.tolist(), strict=True)
    pairs = {tuple(sorted(pair)) for pair in ends}
    kinds, partners = model.geom_contype, model.geom_conaffinity

    def is_pair(geom: int, other: int) -> bool:
        if tuple(sorted((geom, other))) in pairs:
            return True
        low, high = sorted(int(model.geom_bodyid[x]) for x in (geom, other))
        top, below = sorted((int(weld[low]), int(weld[high])))
        is_parent = 0 < top == weld[model.body_parentid[below]] and not keep_parents
        if top == below or is_parent or (low << 16) + high in excluded:
            return False
        return bool(kinds[geom] & partners[other] or kinds[other] & partners[geom])

    return is_pair


def geom_label(model: mujoco.MjModel, geom: int) -> tuple[str, str]:
    """Name of a geom, or its number, and its kind, for messages."""
    kind = mujoco.mjtGeom(model.geom_type[geom]).name.removeprefix("mjGEOM_").lower()
    return f"geom '{model.geom(geom).name or geom}'", kind


def _moving_geoms(model: mujoco.MjModel) -> list[int]:
    weld = model.body_weldid[model.geom_bodyid]
    return np.flatnonzero(model.body_dofnum[weld]).tolist()


def _points_of(model: mujoco.MjModel, geom: int) -> tuple[np.ndarray, float]:
    """Points ``(n, 3)``, m, body frame, and radius, m."""
    size, (name, kind) = model.geom_size[geom], geom_label(model, geom)
    if kind == "sphere":
        local, radius = np.zeros((1, 3)), size[0]
    elif kind == "capsule":
        local, radius = np.array([[0, 0, size[1]], [0, 0, -size[1]]]), size[0]
    elif kind == "box":
        local, radius = np.array(list(product((-1, 1), repeat=3))) * size, 0.0
    else:
        raise ValueError(
            f"{name} of body '{model.body(model.geom_bodyid[geom]).name}', which can touch "
            f"the ground, is a {kind}; expected sphere, capsule or box, or contype and "
            "conaffinity that keep it from the ground"
        )
    turn = quat_matrix(model.geom_quat[geom])
    return local @ turn.T + model.geom_pos[geom], float(radius)


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
    leaders: list[int] = []
    for i in range(len(bodies)):
        if not base.is_floating and np.ptp(track[i], 0).max() < 1e-9:
            leaders.append(-1)
            continue
        twins = (
            k
            for k in range(i)
            if leaders[k] == k and radii[i] == radii[k]
            if abs(track[i] - track[k]).max() < 1e-9
        )
        leaders.append(next(twins, i))
    return leaders
