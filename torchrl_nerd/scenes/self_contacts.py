"""Pairs of a robot's own shapes that come near each other, each shape as a capsule.

Spheres and capsules are exact. Any other shape is a capsule along the longest side of a
cuboid about it, as long as that, its radius the mean of half the other two sides. It is off
by as much as those differ, and at corners by up to 0.73 of its radius.
"""

from dataclasses import dataclass

import mujoco
import numpy as np
import torch

from torchrl_nerd.geometry.rotations import quat_matrix
from torchrl_nerd.geometry.segments import between_segments
from torchrl_nerd.scenes.contact_points import own_contacts
from torchrl_nerd.scenes.ranges import position_ranges
from torchrl_nerd.scenes.shapes import geom_kind

MAX_PAIRS = 16
MARGIN_PER_RADIUS = 2.0  # of the sum of both radii
MAX_MARGIN = 0.1  # m
NEAR = 0.25  # of the margin: how often pairs are nearer in random poses ranks them
POSES, TOGETHER = 1024, 32


@dataclass(frozen=True)
class CapsulePairs:
    """P pairs of capsules, those that are near most often in random poses first."""

    geoms: np.ndarray  # (P, 2), ids of what the capsules stand for
    bodies: np.ndarray  # (2, 2, P), of either end of the first and the second capsule
    ends: np.ndarray  # (2, 2, P, 3), of their axes, m, body frame
    radii: np.ndarray  # (P,), m: sum of both
    margins: np.ndarray  # (P,), m: distance beyond which a pair has no features

    def __len__(self) -> int:
        return len(self.geoms)

    @classmethod
    def of(cls, model: mujoco.MjModel, geoms: np.ndarray) -> "CapsulePairs":
        """The capsules of pairs of geoms ``(P, 2)``."""
        capsules = [_capsule(model, geom) for geom in geoms.T.flat]
        ends = np.array([c[0] for c in capsules]).reshape(2, -1, 2, 3)
        radii = np.array([c[1] for c in capsules]).reshape(2, -1).sum(0)
        bodies = np.repeat(model.geom_bodyid[geoms.T][:, None], 2, 1)
        margins = np.minimum(MARGIN_PER_RADIUS * radii, MAX_MARGIN)
        return cls(geoms, bodies, ends.transpose(0, 2, 1, 3), radii, margins)

    def placed(self, data: mujoco.MjData, qpos: np.ndarray) -> np.ndarray:
        """The ends in the world ``(2, 2, P, 3)``, m, of a robot at ``qpos (nq,)``."""
        data.qpos[:] = qpos
        mujoco.mj_kinematics(data.model, data)
        turns = data.xmat[self.bodies].reshape(*self.bodies.shape, 3, 3)
        return data.xpos[self.bodies] + (turns @ self.ends[..., None])[..., 0]


def capsule_pairs(model: mujoco.MjModel) -> CapsulePairs:
    """Pairs of own shapes that MuJoCo's filter lets touch and that ever come near.

    The `MAX_PAIRS` that are nearer than `NEAR` of their margin in most of `POSES` random
    poses within the joints' limits.
    """
    pairs = CapsulePairs.of(model, np.array(own_contacts(model), int).reshape(-1, 2))
    if not len(pairs):
        return pairs
    data = mujoco.MjData(model)
    low, high = position_ranges(model)
    poses = np.random.default_rng(0).uniform(low, high, (POSES, model.nq))
    shares = np.zeros(len(pairs))
    for some in np.split(poses, POSES // TOGETHER):
        ends = np.stack([pairs.placed(data, qpos) for qpos in some], 2)
        way, *_ = between_segments(*torch.from_numpy(ends).flatten(0, 1))
        gaps = np.linalg.norm(way, axis=-1) - pairs.radii
        shares += (gaps < NEAR * pairs.margins).sum(0) / POSES
    order = np.argsort(-shares, kind="stable")[:MAX_PAIRS]
    return CapsulePairs.of(model, pairs.geoms[order[shares[order] > 0.0]])


def _capsule(model: mujoco.MjModel, geom: int) -> tuple[np.ndarray, float]:
    """Ends ``(2, 3)``, m, in the body's frame, and radius, m."""
    half, centre = model.geom_size[geom].copy(), np.zeros(3)
    kind, (radius, length, _) = geom_kind(model, geom), half
    if kind == "sphere":
        half[:] = radius
    elif kind in ("capsule", "cylinder"):
        half[:] = radius, radius, length + radius * (kind == "capsule")
    elif kind == "mesh":
        centre, half = np.split(model.geom_aabb[geom], 2)
    longest = int(half.argmax())
    radius = min(float(np.delete(half, longest).mean()), float(half[longest]))
    along = np.zeros(3)
    along[longest] = half[longest] - radius
    ends = np.stack((centre - along, centre + along))
    return ends @ quat_matrix(model.geom_quat[geom]).T + model.geom_pos[geom], radius
