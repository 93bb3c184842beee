"""The configuration manifold of a MuJoCo model: positions plus tangent vectors.

``qpos`` is a point and ``qvel`` a tangent vector: hinges and slides are scalars, ball and
free joints carry a quaternion. Same definitions as ``mj_integratePos`` and
``mj_differentiatePos`` (https://mujoco.readthedocs.io/en/stable/APIreference).
"""

from dataclasses import dataclass
from functools import cached_property

import mujoco
import torch
from torch import Tensor

from torchrl_nerd.geometry.rotations import (
    quat_conjugate,
    quat_exp,
    quat_log,
    quat_multiply,
    quat_normalize,
)

FREE, BALL, SLIDE, HINGE = (
    int(getattr(mujoco.mjtJoint, f"mjJNT_{kind}"))
    for kind in ("FREE", "BALL", "SLIDE", "HINGE")
)


UNIT = 1e-15  # mjMINVAL


@dataclass(frozen=True)
class JointLayout:
    """Where each joint lives in ``qpos`` and ``qvel``: (qpos address, dof address)."""

    nq: int
    nv: int
    linear: tuple[tuple[int, int], ...]  # of every entry that adds like a number
    rotations: tuple[tuple[int, int], ...]  # of every quaternion
    translations: tuple[int, ...] = ()  # dof address of every free joint

    @classmethod
    def from_model(cls, model: mujoco.MjModel) -> "JointLayout":
        """Read the joints of a compiled model."""
        linear, rotations, translations = [], [], []
        for joint in range(model.njnt):
            q, v = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
            kind = int(model.jnt_type[joint])
            if kind == FREE:
                linear += [(q + i, v + i) for i in range(3)]
                rotations.append((q + 3, v + 3))
                translations.append(v)
            elif kind == BALL:
                rotations.append((q, v))
            else:
                linear.append((q, v))
        parts = (tuple(x) for x in (linear, rotations, translations))
        return cls(model.nq, model.nv, *parts)

    @cached_property
    def runs(self) -> tuple[tuple[slice, slice], ...]:
        """``linear`` as slices of qpos and qvel, each as long as it gets."""
        found: list[list[int]] = []
        for q, v in self.linear:
            if found and (q, v) == (found[-1][0] + found[-1][2], sum(found[-1][1:])):
                found[-1][2] += 1
            else:
                found.append([q, v, 1])
        return tuple((slice(q, q + n), slice(v, v + n)) for q, v, n in found)


def body_joints(model: mujoco.MjModel, body: int) -> range:
    """Ids of a body's joints."""
    start = int(model.body_jntadr[body])
    return range(start, start + int(model.body_jntnum[body]))


def joint_label(model: mujoco.MjModel, joint: int) -> str:
    """A joint's name; ``joint 3`` where it has none."""
    return model.joint(joint).name or f"joint {joint}"


def integrate_pos(layout: JointLayout, qpos: Tensor, tangent: Tensor) -> Tensor:
    """``qpos`` moved along ``tangent`` (velocity times time), ``(*batch, nq)``.

    Linear parts add in world axes; quaternions are multiplied from the right by the
    exponential of the body-axes rotation vector and normalised.
    """
    if not layout.rotations:
        return qpos + tangent
    parts = {q.start: qpos[..., q] + tangent[..., v] for q, v in layout.runs}
    for q, v in layout.rotations:
        turned = quat_multiply(qpos[..., q : q + 4], quat_exp(tangent[..., v : v + 3]))
        parts[q] = quat_normalize(turned)
    return torch.cat([parts[first] for first in sorted(parts)], -1)


def normalize_pos(layout: JointLayout, qpos: Tensor) -> Tensor:
    """``qpos (*batch, nq)`` with unit quaternions, as MuJoCo reads it.

    By MuJoCo's rule: one within `UNIT` of length one stays as it is, bit for bit.
    """
    for q, _ in layout.rotations:
        quat = qpos[..., q : q + 4]
        error = torch.linalg.vector_norm(quat, dim=-1, keepdim=True) - 1.0
        quat = torch.where(error.abs() > UNIT, quat_normalize(quat), quat)
        qpos = torch.cat((qpos[..., :q], quat, qpos[..., q + 4 :]), -1)
    return qpos


def differentiate_pos(layout: JointLayout, start: Tensor, end: Tensor) -> Tensor:
    """Tangent vector that takes ``start`` to ``end``, ``(*batch, nv)``."""
    if not layout.rotations:
        return end - start
    parts = {v.start: end[..., q] - start[..., q] for q, v in layout.runs}
    for q, v in layout.rotations:
        turn = quat_multiply(quat_conjugate(start[..., q : q + 4]), end[..., q : q + 4])
        parts[v] = quat_log(turn)
    return torch.cat([parts[first] for first in sorted(parts)], -1)
