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

from torchrl_nerd.geometry.frames import quat_normalize

FREE, BALL, SLIDE, HINGE = (
    int(mujoco.mjtJoint.mjJNT_FREE),
    int(mujoco.mjtJoint.mjJNT_BALL),
    int(mujoco.mjtJoint.mjJNT_SLIDE),
    int(mujoco.mjtJoint.mjJNT_HINGE),
)


BodyPose = tuple[Tensor, Tensor, Tensor, Tensor]
"""Origin (m), rotation matrix, angular velocity (rad/s) and velocity of the origin (m/s)
of a body, in B_t and relative to it."""


@dataclass(frozen=True)
class Base:
    """The body whose pose defines B_t.

    A floating base is the body of the free joint. A fixed base is the mount: the pose,
    constant in the world, of the first moving body's frame before its joints move.
    """

    body: int
    is_floating: bool
    qpos_address: int = 0
    dof_address: int = 0

    @classmethod
    def from_model(cls, model: mujoco.MjModel) -> "Base":
        """Find the base.

        Raises:
            ValueError: the model has no joint, or more than one moving tree.
        """
        roots = [
            body
            for body in range(1, model.nbody)
            if model.body_dofnum[body] > 0
            and model.body_weldid[body] == body
            and model.body_weldid[model.body_parentid[body]] == 0
        ]
        if len(roots) != 1:
            found = "no joint" if not roots else f"{len(roots)} moving trees"
            raise ValueError(f"expected a model with one robot, got {found}")
        joint = int(model.body_jntadr[roots[0]])
        if model.jnt_type[joint] != FREE:
            return cls(roots[0], False)
        q, v = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
        return cls(roots[0], True, q, v)


def mount_pose(model: mujoco.MjModel, base: Base) -> tuple[np.ndarray, np.ndarray]:
    """World position ``(3,)`` and rotation ``(3, 3)`` of a fixed base's mount."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    parent = int(model.body_parentid[base.body])
    rotation = data.xmat[parent].reshape(3, 3)
    position = data.xpos[parent] + rotation @ model.body_pos[base.body]
    return position, rotation @ quat_matrix(model.body_quat[base.body])


def quat_matrix(quat: np.ndarray) -> np.ndarray:
    """Rotation matrix ``(3, 3)`` of one quaternion ``wxyz``."""
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quat)
    return matrix.reshape(3, 3)


def skew(v: np.ndarray) -> np.ndarray:
    """Cross-product matrix: ``skew(v) @ w = v x w``."""
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]], float)


@dataclass(frozen=True)
class _Joint:
    kind: int
    qpos_address: int
    dof_address: int
    rest: float  # qpos0: the position at which the body stands as the file wrote it
    is_at_origin: bool
    constants: str  # name of the buffer [axis, anchor, skew(axis), skew(axis)^2]


class PointKinematics(nn.Module):
    """Positions and velocities of body-fixed points, in and relative to the base frame.

    Args:
        model: compiled model.
        base: its base, from `Base.from_model`.
        bodies: body id of each of the P points.
        positions: ``(P, 3)``, m, in the body's frame.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        base: Base,
        bodies: list[int],
        positions: np.ndarray,
    ) -> None:
        super().__init__()
        self.base = base
        self.points_of: dict[int, list[int]] = {}
        for index, body in enumerate(bodies):
            self.points_of.setdefault(body, []).append(index)
        self.order = [i for points in self.points_of.values() for i in points]
        self.inverse_order = [int(i) for i in np.argsort(self.order)]
        self.chain = _bodies_on_path(model, base, bodies)
        self.parent = {b: int(model.body_parentid[b]) for b in self.chain}
        self.joints = {b: self._joints(model, b) for b in self.chain}
        for body in self.chain:
            self._constant(f"pos_{body}", model.body_pos[body])
            self._constant(f"rot_{body}", quat_matrix(model.body_quat[body]))
        for body, points in self.points_of.items():
            self._constant(f"points_{body}", positions[points])

    def _constant(self, name: str, value: np.ndarray) -> None:
        tensor = torch.as_tensor(np.array(value), dtype=torch.float64)
        self.register_buffer(name, tensor, persistent=False)

    def _joints(self, model: mujoco.MjModel, body: int) -> list[_Joint]:
        start, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
        joints = []
        for j in range(start, start + count):
            if model.jnt_type[j] == FREE:
                continue
            axis, anchor = model.jnt_axis[j], model.jnt_pos[j]
            k = skew(axis)
            self._constant(f"joint_{j}", np.vstack((axis, anchor, k, k @ k)))
            q, v = int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j])
            is_ball = model.jnt_type[j] == BALL
            rest = 0.0 if is_ball else float(model.qpos0[q])
            kind = int(model.jnt_type[j])
            joints.append(_Joint(kind, q, v, rest, not anchor.any(), f"joint_{j}"))
        return joints

    def forward(self, qpos: Tensor, qvel: Tensor) -> tuple[Tensor, Tensor]:
        """Positions and velocities of the points relative to the base frame.

        Args:
            qpos: ``(*batch, nq)``, float64.
            qvel: ``(*batch, nv)``, float64.

        Returns:
            positions ``(*batch, P, 3)``, m, and velocities ``(*batch, P, 3)``, m/s, as
            seen by an observer who rides on the base; both in B_t.
        """
        at_base = _at_rest(qpos)
        pose = {self.base.body: at_base}
        positions, velocities = [], []
        for body in self.chain:
            parent = at_base if body == self.base.body else pose[self.parent[body]]
            pose[body] = self._body_pose(body, parent, qpos, qvel)
        for body in self.points_of:
            position, rotation, omega, velocity = pose[body]
            arm = getattr(self, f"points_{body}") @ rotation.mT
            positions.append(position[..., None, :] + arm)
            turning = torch.linalg.cross(omega[..., None, :].expand_as(arm), arm)
            velocities.append(velocity[..., None, :] + turning)
        order = self.inverse_order
        position, velocity = torch.cat(positions, -2), torch.cat(velocities, -2)
        return position[..., order, :], velocity[..., order, :]

    def _body_pose(
        self, body: int, parent: BodyPose, qpos: Tensor, qvel: Tensor
    ) -> BodyPose:
        """Pose and motion of one body: its place in the parent, then its joints."""
        position, rotation, omega, velocity = parent
        if body != self.base.body:
            offset = rotation @ getattr(self, f"pos_{body}")
            position = position + offset
            velocity = velocity + torch.linalg.cross(omega, offset)
            rotation = rotation @ getattr(self, f"rot_{body}")
        for joint in self.joints[body]:
            constants = getattr(self, joint.constants)
            q = qpos[..., joint.qpos_address] - joint.rest
            v = qvel[..., joint.dof_address, None]
            axis = rotation @ constants[0]
            if joint.kind == SLIDE:
                position = position + axis * q[..., None]
                velocity = velocity + torch.linalg.cross(omega, axis * q[..., None])
                velocity = velocity + axis * v
                continue
            if joint.kind == HINGE:
                sine, cosine = q.sin()[..., None, None], q.cos()[..., None, None]
                turn = eye_like(sine) + sine * constants[2:5]
                turn = turn + (1.0 - cosine) * constants[5:8]
                spin = axis * v
            else:
                a, d = joint.qpos_address, joint.dof_address
                turn = matrix_from_quat(quat_normalize(qpos[..., a : a + 4]))
                local = qvel[..., d : d + 3, None]
                spin = (rotation @ turn @ local)[..., 0]
            turned = rotation @ turn
            if not joint.is_at_origin:  # the body swings about the joint's anchor
                before, after = rotation @ constants[1], turned @ constants[1]
                velocity = velocity + torch.linalg.cross(omega, before)
                velocity = velocity - torch.linalg.cross(omega + spin, after)
                position = position + before - after
            omega = omega + spin
            rotation = turned
        return position, rotation, omega, velocity


def _at_rest(qpos: Tensor) -> BodyPose:
    zero = qpos.new_zeros(*qpos.shape[:-1], 3)
    return zero, eye_like(qpos).expand(*qpos.shape[:-1], 3, 3), zero, zero


def eye_like(x: Tensor) -> Tensor:
    """The 3 x 3 identity with the dtype and device of ``x``."""
    return torch.eye(3, dtype=x.dtype, device=x.device)


def matrix_from_quat(q: Tensor) -> Tensor:
    """Rotation matrices ``(*batch, 3, 3)`` of unit quaternions ``(*batch, 4)``."""
    w, x, y, z = q.unbind(-1)
    rows = (
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


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
