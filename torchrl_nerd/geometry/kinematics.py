"""Forward kinematics of points on a robot, in the robot's own frame.

Positions and velocities of a few body-fixed points come from one pass down the tree of
the compiled MuJoCo model, visiting only bodies that carry a point. Everything is written
relative to the base frame, so distance from the world's origin never costs digits.
Source: Featherstone, "Rigid Body Dynamics Algorithms" (2008), section 4.4.
"""

from collections import defaultdict

import mujoco
import numpy as np
import torch
from torch import Tensor, nn

from torchrl_nerd.geometry.base import Base, ancestors, is_free, keep_constants
from torchrl_nerd.geometry.constants import take
from torchrl_nerd.geometry.manifold import BALL, SLIDE, body_joints
from torchrl_nerd.geometry.motion import (
    Motion,
    cross,
    join,
    keep,
    matmul,
    pick,
    rotate_by,
)
from torchrl_nerd.geometry.other_trees import OtherTrees
from torchrl_nerd.geometry.rotations import (
    matrix_from_quat,
    quat_matrix,
    quat_normalize,
)


class PointKinematics(nn.Module):
    """Positions and velocities of body-fixed points, in and relative to the base frame.

    Bodies of equal depth and kind are moved together: four legs cost as much as one. The P
    points are on ``bodies``, at ``positions (P, 3)``, m, in their frames.

    Raises:
        ValueError: a point on a body that does not move with the base.
    """

    points: Tensor

    def __init__(
        self,
        model: mujoco.MjModel,
        base: Base,
        bodies: list[int],
        positions: np.ndarray,
    ) -> None:
        super().__init__()
        self.base, self.depths = base, nn.ModuleList()
        self.trees = OtherTrees(model, base) if base.others else None
        roots = (base.body, *base.others)
        # roots whose pose is a state, and those that stand in the world
        above = {r: i for i, r in enumerate(roots) if is_free(model, r)}
        standing = {r: i for i, r in enumerate(roots) if not is_free(model, r)}
        depth: dict[int, int] = {}
        # by depth, then by kinds of joints
        levels: dict[int, dict[tuple, list[int]]] = defaultdict(dict)
        for body in _bodies_on_path(model, above, standing, bodies):  # parents first
            depth[body] = depth.get(int(model.body_parentid[body]), -1) + 1
            kinds = tuple(model.jnt_type[body_joints(model, body)].tolist())
            levels[depth[body]].setdefault(kinds, []).append(body)
        self.shows_roots = len(roots) > 1 or base.is_floating
        # a place in the world is no body: its root comes later
        order = [r if r in above else -r for r in roots] if self.shows_roots else []
        for level in levels.values():
            groups = (_Group(model, standing, x, above) for x in level.values())
            self.depths.append(nn.ModuleList(groups))
            ordered = [body for alike in level.values() for body in alike]
            above = {body: index for index, body in enumerate(ordered)}
            order += ordered
        self.body_of_point = [order.index(body) for body in bodies]
        keep(self, points=np.asarray(positions).reshape(-1, 3))

    def forward(self, qpos: Tensor, qvel: Tensor) -> tuple[Tensor, Tensor]:
        """Positions and velocities of the points, as seen from the base; both in B_t.

        From ``qpos (*batch, nq)`` and ``qvel (*moving, nv)``: positions ``(*batch, P, 3)``,
        m, and velocities ``(*moving, P, 3)``, m/s. Where there are fewer velocities than
        positions, the first positions have one; none has of a ``qvel`` without rows.
        """
        q, v = (x.reshape(-1, x.shape[-1]).T.contiguous() for x in (qpos, qvel))
        position, rotation, omega, velocity = self.body_motion(q, v)
        arm = rotate_by(rotation, self.points)  # (3, P, N)
        velocity = velocity + cross(omega, arm[..., : v.shape[-1]])
        return tuple(  # pyright: ignore
            x.expand(*x.shape[:-1], rows.shape[-1])
            .permute(2, 1, 0)  # (3, P, N) -> (N, P, 3)
            .reshape(*like.shape[:-1], *x.shape[1::-1])
            for x, rows, like in ((position + arm, q, qpos), (velocity, v, qvel))
        )

    def body_motion(self, q: Tensor, v: Tensor) -> Motion:
        """Of every point's body; ``q (nq, N)`` and ``v (nv, moving)`` are contiguous."""
        zero, still = q.new_zeros(3, 1, 1), v.new_zeros(3, 1, min(1, v.shape[-1]))
        identity = torch.eye(3, dtype=q.dtype, device=q.device)[..., None, None]
        above = zero, identity, still, still  # the base itself, seen from the base
        if self.trees is not None:
            above = join([above, self.trees(q, v)])
        motions = [above] if self.shows_roots else []
        for groups in self.depths:
            above = join([group(above, q, v) for group in groups])  # pyright: ignore
            motions.append(above)
        return pick(join(motions), self.body_of_point)


class _Group(nn.Module):
    """Bodies at one depth of the tree that have joints of the same kinds."""

    offset: Tensor  # (3, n, 1), m, in the parent
    turn: Tensor  # (3, 3, n, 1), to the parent

    def __init__(
        self,
        model: mujoco.MjModel,
        standing: dict[int, int],
        bodies: list[int],
        above: dict[int, int],
    ) -> None:
        super().__init__()
        self.parents, offsets, turns = [], [], []
        for body in bodies:
            if body in standing:  # its parent's motion is that of its place itself
                self.parents.append(standing[body])
                offsets.append(np.zeros(3))
                turns.append(np.eye(3))
            else:
                self.parents.append(above[int(model.body_parentid[body])])
                offsets.append(model.body_pos[body])
                turns.append(quat_matrix(model.body_quat[body]))
        self.joints = nn.ModuleList()
        slots = zip(*(body_joints(model, body) for body in bodies), strict=True)
        for joints in slots:  # the first joints of all bodies, then the second ones
            self.joints.append(_Joint(model, list(joints), turns))
            turns = [np.eye(3)] * len(bodies)
        keep(self, offset=offsets, turn=turns)

    def forward(self, above: Motion, qpos: Tensor, qvel: Tensor) -> Motion:
        """From the motion of the depth above: places in the parents, then joints."""
        position, rotation, omega, velocity = pick(above, self.parents)
        offset = rotate_by(rotation, self.offset)
        velocity = velocity + cross(omega, offset[..., : qvel.shape[-1]])
        motion = position + offset, rotation, omega, velocity
        for joint in self.joints:
            motion = joint(motion, qpos, qvel)
        if not self.joints:  # a body that is welded to its parent
            motion = motion[0], matmul(rotation, self.turn), omega, velocity
        return motion


class _Joint(nn.Module):
    """One joint of each body of a group.

    With K the cross-product matrix of its axis, a hinge's rotation by q is
    I + K^2 + sin(q) K - cos(q) K^2. Constants are in the frame before ``turns``.
    """

    axis: Tensor  # (3, n, 1)
    start: Tensor  # (3, n, 1), m: the anchor before the joint moves
    anchor: Tensor  # (3, n, 1), m, in the body
    rest: Tensor  # (n, 1)
    turn: Tensor  # (3, 3, n, 1)
    middle: Tensor  # (n, 9, 1): turn (I + K^2)
    swing: Tensor  # (n, 9, 2): turn K and -turn K^2

    def __init__(
        self, model: mujoco.MjModel, joints: list[int], turns: list[np.ndarray]
    ) -> None:
        super().__init__()
        self.kind = int(model.jnt_type[joints[0]])
        self.qpos_at = model.jnt_qposadr[joints].tolist()
        self.dof_at = model.jnt_dofadr[joints].tolist()
        axes, anchors = model.jnt_axis[joints], model.jnt_pos[joints]
        self.is_at_origin = not anchors.any()
        # qpos0: the position at which the body stands as the file wrote it
        rest = np.zeros(len(joints)) if self.kind == BALL else model.qpos0[self.qpos_at]
        crosses = [np.cross(np.eye(3), axis) for axis in axes]
        pairs = list(zip(turns, crosses, strict=True))
        swings = [np.stack((r @ k, -r @ k @ k), -1) for r, k in pairs]
        keep_constants(
            self,
            middle=np.reshape([r @ (np.eye(3) + k @ k) for r, k in pairs], (-1, 9, 1)),
            swing=np.reshape(swings, (-1, 9, 2)),
        )
        keep(
            self,
            axis=[r @ axis for r, axis in zip(turns, axes, strict=True)],
            start=[r @ anchor for r, anchor in zip(turns, anchors, strict=True)],
            anchor=anchors,
            rest=rest,
            turn=turns,
        )

    def forward(self, motion: Motion, qpos: Tensor, qvel: Tensor) -> Motion:
        """The bodies' motion after this joint."""
        position, rotation, omega, velocity = motion
        moving = slice(qvel.shape[-1])  # the robots that have velocities
        if self.kind == BALL:
            quat = torch.stack([qpos[at : at + 4].T for at in self.qpos_at], -3)
            turn = matrix_from_quat(quat_normalize(quat)).movedim((-2, -1), (0, 1))
            turned = matmul(matmul(rotation, self.turn), turn)
            local = torch.stack([qvel[at : at + 3] for at in self.dof_at], 1)
            spin = rotate_by(turned[..., moving], local)
        else:
            q = take(qpos, self.qpos_at, 0) - self.rest  # (n, N)
            v = take(qvel, self.dof_at, 0)
            axis = rotate_by(rotation, self.axis)
            spin = axis[..., moving] * v
            if self.kind == SLIDE:
                path = axis * q
                velocity = velocity + cross(omega, path[..., moving]) + spin
                return position + path, matmul(rotation, self.turn), omega, velocity
            waves = torch.stack((q.sin(), q.cos()), 1)  # (n, 2, N)
            if torch.compiler.is_compiling():  # which else finds sines for each entry
                turn = torch.baddbmm(self.middle, self.swing, waves)
            else:  # the same bits in any batch
                sine, cosine = waves[:, :1], waves[:, 1:]
                turn = torch.addcmul(self.middle, self.swing[..., :1], sine)
                turn = torch.addcmul(turn, self.swing[..., 1:], cosine)
            turned = matmul(rotation, turn.unflatten(1, (3, 3)).movedim(0, 2))
        if not self.is_at_origin:  # the body swings about the joint's anchor
            before = rotate_by(rotation, self.start)
            after = rotate_by(turned, self.anchor)
            velocity = velocity + cross(omega, before[..., moving])
            velocity = velocity - cross(omega + spin, after[..., moving])
            position = position + before - after
        return position, turned, omega + spin, velocity


def _bodies_on_path(
    model: mujoco.MjModel,
    above: dict[int, int],
    standing: dict[int, int],
    bodies: list[int],
) -> list[int]:
    """Bodies from the roots to the points' bodies, parents first; free roots left out."""
    on_way = ancestors(model)  # [body, body on its way to the world]
    moves = np.any(on_way[:, [*above, *standing]], 1)
    if not moves[bodies].all():
        raise ValueError("expected contact points on moving bodies of the robot")
    moves[list(above)] = False
    return np.flatnonzero(on_way[bodies].any(0) & moves).tolist()
