"""Forward kinematics of points on a robot, in the robot's own frame.

Positions and velocities of a few body-fixed points come from one pass down the tree of
the compiled MuJoCo model, visiting only bodies that carry a point. Everything is written
relative to the base frame, so distance from the world's origin never costs digits.
Source: Featherstone, "Rigid Body Dynamics Algorithms" (2008), section 4.4.
"""

from dataclasses import dataclass

import mujoco
import numpy as np
import torch
from torch import Tensor, nn

from torchrl_nerd.geometry.base import Base
from torchrl_nerd.geometry.manifold import BALL, FREE, SLIDE
from torchrl_nerd.geometry.motion import (
    Motion,
    at_rest,
    cross,
    join,
    matmul,
    pick,
    rotate_by,
)
from torchrl_nerd.geometry.rotations import (
    matrix_from_quat,
    quat_matrix,
    quat_normalize,
)


def skew(v: np.ndarray) -> np.ndarray:
    """Cross-product matrix: ``skew(v) @ w = v x w``."""
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]], float)


@dataclass(frozen=True)
class _Group:
    """Bodies at one depth of the tree that have joints of the same kinds."""

    name: str  # of its buffers
    bodies: list[int]
    parents: list[int]  # places in the depth above
    kinds: tuple[int, ...]
    qpos_addresses: list[list[int]]  # per joint, per body
    dof_addresses: list[list[int]]
    is_at_origin: list[bool]  # per joint: every anchor is the body's origin


class PointKinematics(nn.Module):
    """Positions and velocities of body-fixed points, in and relative to the base frame.

    Bodies of equal depth and kind are moved together: four legs cost as much as one.

    Args:
        model: compiled model.
        base: its base, from `Base.from_model`.
        bodies: body id of each of the P points.
        positions: ``(P, 3)``, m, in the body's frame.
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
        self.base = base
        depth: dict[int, int] = {}
        for body in _bodies_on_path(model, base, bodies):  # parents first
            depth[body] = depth.get(int(model.body_parentid[body]), -1) + 1
        self.depths: list[list[_Group]] = []
        order, above = [base.body] if base.is_floating else [], {base.body: 0}
        for level in range(max(depth.values(), default=-1) + 1):
            here = [body for body in depth if depth[body] == level]
            groups = self._groups(model, here, above, level)
            ordered = [body for group in groups for body in group.bodies]
            above = {body: index for index, body in enumerate(ordered)}
            order += ordered
            self.depths.append(groups)
        self.body_of_point = [order.index(body) for body in bodies]
        self._constant("points", np.asarray(positions).reshape(-1, 3))

    def _constant(self, name: str, per_body: object) -> None:
        """Keep ``(n, *size)`` as ``(*size, n, 1)``."""
        tensor = torch.as_tensor(np.array(per_body), dtype=torch.float64)
        tensor = tensor.movedim(0, -1)[..., None].contiguous()
        self.register_buffer(name, tensor, persistent=False)

    def _groups(
        self,
        model: mujoco.MjModel,
        bodies: list[int],
        above: dict[int, int],
        depth: int,
    ) -> list[_Group]:
        by_kind: dict[tuple[int, ...], list[int]] = {}
        for body in bodies:
            kinds = tuple(int(model.jnt_type[j]) for j in _joints(model, body))
            by_kind.setdefault(kinds, []).append(body)
        groups = []
        for number, (kinds, members) in enumerate(by_kind.items()):
            name = f"{depth}_{number}"
            is_base = members[0] == self.base.body  # a fixed base's mount is B_t itself
            places = [np.zeros(3) if is_base else model.body_pos[b] for b in members]
            turns = [
                np.eye(3) if is_base else quat_matrix(model.body_quat[b])
                for b in members
            ]
            self._constant(f"pos_{name}", places)
            slots = list(zip(*(_joints(model, body) for body in members), strict=True))
            for slot, joints in enumerate(slots):
                self._joint_constants(model, f"{name}_{slot}", joints, turns)
                turns = [np.eye(3)] * len(members)
            self._constant(f"rot_{name}", turns)
            at = [0 if is_base else above[int(model.body_parentid[b])] for b in members]
            groups.append(
                _Group(
                    name,
                    members,
                    at,
                    kinds,
                    [[int(model.jnt_qposadr[j]) for j in joints] for joints in slots],
                    [[int(model.jnt_dofadr[j]) for j in joints] for joints in slots],
                    [
                        not any(model.jnt_pos[j].any() for j in joints)
                        for joints in slots
                    ],
                )
            )
        return groups

    def _joint_constants(
        self,
        model: mujoco.MjModel,
        name: str,
        joints: tuple[int, ...],
        turns: list[np.ndarray],
    ) -> None:
        """A joint's constants, turned into the frame in which ``turns`` places it.

        With K the cross-product matrix of its axis, a hinge's rotation by q is
        I + sin(q) K + (1 - cos(q)) K^2.
        """
        crosses = [skew(model.jnt_axis[j]) for j in joints]
        # qpos0: the position at which the body stands as the file wrote it
        rest = [
            0.0 if model.jnt_type[j] == BALL else model.qpos0[model.jnt_qposadr[j]]
            for j in joints
        ]
        pairs = list(zip(turns, joints, strict=True))
        self._constant(f"axis_{name}", [r @ model.jnt_axis[j] for r, j in pairs])
        self._constant(f"from_{name}", [r @ model.jnt_pos[j] for r, j in pairs])
        self._constant(f"anchor_{name}", [model.jnt_pos[j] for j in joints])
        self._constant(f"rest_{name}", rest)
        self._constant(f"still_{name}", turns)
        kept = zip(turns, crosses, strict=True)
        crosses = [(r @ k, r @ k @ k) for r, k in kept]
        self._constant(f"cross_{name}", [k for k, _ in crosses])
        self._constant(f"square_{name}", [k for _, k in crosses])

    def forward(self, qpos: Tensor, qvel: Tensor) -> tuple[Tensor, Tensor]:
        """Positions and velocities of the points relative to the base frame.

        Where there are fewer velocities than positions, the first positions have one.

        Args:
            qpos: ``(*batch, nq)``, float64.
            qvel: ``(*moving, nv)``, float64; of no rows where only positions are wanted.

        Returns:
            positions ``(*batch, P, 3)``, m, and velocities ``(*moving, P, 3)``, m/s, as
            seen by an observer who rides on the base; both in B_t.
        """
        q, v = (x.reshape(-1, x.shape[-1]).T.contiguous() for x in (qpos, qvel))
        above = at_rest(q, v)
        motions = [above] if self.base.is_floating else []
        for groups in self.depths:
            moved = [self._move(g, pick(above, g.parents), q, v) for g in groups]
            above = join(moved)
            motions.append(above)
        position, rotation, omega, velocity = pick(join(motions), self.body_of_point)
        arm = rotate_by(rotation, self.points)
        velocity = velocity + cross(omega, arm[..., : v.shape[-1]])
        return tuple(  # pyright: ignore
            x.expand(*x.shape[:-1], rows.shape[-1])
            .permute(2, 1, 0)
            .reshape(*like.shape[:-1], *x.shape[1::-1])
            for x, rows, like in ((position + arm, q, qpos), (velocity, v, qvel))
        )

    def _move(
        self, group: _Group, parent: Motion, qpos: Tensor, qvel: Tensor
    ) -> Motion:
        """Motion of a group: its places in the parents, then its joints."""
        position, rotation, omega, velocity = parent
        moving = slice(qvel.shape[-1])  # the rows that have velocities
        offset = rotate_by(rotation, getattr(self, f"pos_{group.name}"))
        position = position + offset
        velocity = velocity + cross(omega, offset[..., moving])
        for slot, kind in enumerate(group.kinds):
            if kind == FREE:
                continue
            name = f"{group.name}_{slot}"
            q_at, v_at = group.qpos_addresses[slot], group.dof_addresses[slot]
            still = getattr(self, f"still_{name}")
            if kind == BALL:
                quat = torch.stack([qpos[at : at + 4].T for at in q_at], -3)
                turn = matrix_from_quat(quat_normalize(quat)).movedim((-2, -1), (0, 1))
                turned = matmul(matmul(rotation, still), turn)
                local = torch.stack([qvel[d : d + 3] for d in v_at], 1)
                spin = rotate_by(turned[..., moving], local)
            else:
                q, v = qpos[q_at] - getattr(self, f"rest_{name}"), qvel[v_at]
                axis = rotate_by(rotation, getattr(self, f"axis_{name}"))
                if kind == SLIDE:
                    path = axis * q
                    position = position + path
                    velocity = velocity + cross(omega, path[..., moving])
                    velocity = velocity + axis[..., moving] * v
                    rotation = matmul(rotation, still)
                    continue
                turn = torch.addcmul(still, getattr(self, f"cross_{name}"), q.sin())
                bend = getattr(self, f"square_{name}")
                turned = matmul(rotation, torch.addcmul(turn, bend, 1.0 - q.cos()))
                spin = axis[..., moving] * v
            if not group.is_at_origin[slot]:  # the body swings about the joint's anchor
                before = rotate_by(rotation, getattr(self, f"from_{name}"))
                after = rotate_by(turned, getattr(self, f"anchor_{name}"))
                velocity = velocity + cross(omega, before[..., moving])
                velocity = velocity - cross(omega + spin, after[..., moving])
                position = position + before - after
            omega = omega + spin
            rotation = turned
        if not group.kinds:
            rotation = matmul(rotation, getattr(self, f"rot_{group.name}"))
        return position, rotation, omega, velocity


def _joints(model: mujoco.MjModel, body: int) -> range:
    start = int(model.body_jntadr[body])
    return range(start, start + int(model.body_jntnum[body]))


def _bodies_on_path(model: mujoco.MjModel, base: Base, bodies: list[int]) -> list[int]:
    """Bodies between the base and any point's body, parents first.

    A floating base, which is B_t itself, is left out.
    """
    needed: set[int] = set()
    for body in bodies:
        while body != base.body:
            if body == 0:
                raise ValueError(
                    "expected contact points on moving bodies of the robot"
                )
            needed.add(body)
            body = int(model.body_parentid[body])
        if not base.is_floating:
            needed.add(base.body)
    return sorted(needed)
