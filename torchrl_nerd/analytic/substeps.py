"""MuJoCo's substeps of contact and limit forces, while the rest of the dynamics is frozen.

The contact Jacobian and the smooth acceleration change linearly from one `FrozenDynamics`
to another; the mass matrix is that of the second one. All tensors have the batch last.

A contact that slides is the point of MuJoCo's elliptic friction cone that is nearest to the
force of spring and dampers without a cone; its normal force is a little larger than theirs.
Source: https://mujoco.readthedocs.io/en/stable/computation/#constraint-model
"""

from math import ceil
from typing import NamedTuple

import mujoco
import numpy as np
import torch
from torch import Tensor, nn

from torchrl_nerd.analytic.frozen_dynamics import DynamicsEvaluation, FrozenDynamics
from torchrl_nerd.geometry.base import JointAxes, keep_constants, keep_indices
from torchrl_nerd.geometry.motion import cross
from torchrl_nerd.geometry.spd import matvec
from torchrl_nerd.scenes import Scene, penalty_law
from torchrl_nerd.scenes.contact_points import shape_points

MIN_SLIP = 1e-6  # m/s: keeps the direction of slip defined at rest


class SubstepState(NamedTuple):
    """Velocity and displacement since the start of the step; batch last."""

    qvel: Tensor  # (nv, N)
    moved: Tensor  # (nv, N), a tangent of qpos


class SubstepIntegrator(nn.Module):
    """Integrates a robot under penalty contact and limit forces.

    By semi-implicit Euler substeps of ``step_size`` s. Contacts and limits of ``scene``
    must follow the penalty law, with elliptic cones; else ValueError.
    """

    limited_dofs: Tensor  # (L,)
    limited_qpos: Tensor  # (L,)
    scatter: Tensor  # (nv, P C + L)
    contact_law: Tensor  # (7, P, 1)
    limit_law: Tensor  # (4, L, 1)

    def __init__(
        self,
        scene: Scene,
        axes: JointAxes,
        evaluation: DynamicsEvaluation,
        step_size: float,
    ) -> None:
        super().__init__()
        self.step_size, self.evaluation = step_size, evaluation
        self.num_base_dofs = evaluation.num_base_dofs
        model, points = scene.model, scene.contacts
        if model.opt.cone != mujoco.mjtCone.mjCONE_ELLIPTIC:
            raise ValueError(
                "expected elliptic friction cones, got pyramidal ones in scene "
                f"'{scene.name}'"
            )
        law = penalty_law.PenaltyLaw.of_bodies(model, points.bodies)
        _expect_one_law(scene, law)
        # share of the tangential force beyond the cone that becomes normal force
        share = law.friction / model.opt.impratio
        scale = 1.0 / (1.0 + law.friction * share)
        contact = law.stiffness, law.damping, law.slip, law.friction, share, scale
        joints = np.flatnonzero(model.jnt_limited[axes.joints])
        ids = [axes.joints[joint] for joint in joints]
        low, high = model.jnt_range[ids].T
        springs = penalty_law.limit_stiffness(model, ids) if ids else (low, low)
        limited = (2 * self.num_base_dofs + joints).tolist()
        dofs = [*evaluation.jacobian_dofs.tolist(), *limited]
        scatter = np.zeros((model.nv, len(dofs)))  # adds columns to their dofs
        scatter[np.array(dofs, int), range(len(dofs))] = 1.0
        addresses = evaluation.rigid_body.qpos_addresses
        limited_qpos = [addresses[joint] for joint in joints]
        keep_indices(self, limited_dofs=limited, limited_qpos=limited_qpos)
        keep_constants(
            self,
            scatter=scatter,
            contact_law=np.stack((*contact, points.merged.sum(1)))[..., None],
            limit_law=np.stack((*springs, low, high))[..., None],
        )

    def integrate_substeps(
        self,
        first: FrozenDynamics,
        last: FrozenDynamics,
        between: float,
        qpos: Tensor,
        qvel: Tensor,
        num_substeps: float,
    ) -> list[SubstepState]:
        """The state at the start and after each substep, in the base frame of ``last``.

        Jacobian and smooth acceleration change linearly from the ``first`` dynamics to the
        ``last``, ``between`` substeps later; 0: they are one, nothing changes. The start is
        ``qpos (N, nq)`` and ``qvel (N, nv)``; ``num_substeps`` are rounded up.
        """
        step, jacobian, normal, depth, qacc_smooth, inverse, _ = self.step_size, *last
        joints = qpos.mT[self.limited_qpos].to(qacc_smooth)
        speed = self.to_base_frame(qvel.mT, last.rotation.mT).to(qacc_smooth)
        drift = None  # of Jacobian and acceleration, per substep
        if between:
            turn = last.rotation.mT @ first.rotation
            jacobian = _rotated(first.jacobian, turn)
            normal = _rotated(first.normal, turn)
            qacc_smooth = self.to_base_frame(first.qacc_smooth, turn)
            depth, rate = first.depth, 1.0 / between
            changes = last.jacobian - jacobian, last.qacc_smooth - qacc_smooth
            drift = [rate * change for change in changes]
        qacc, jacobian_0, moved = qacc_smooth, jacobian, torch.zeros_like(speed)
        states, scatter = [SubstepState(speed, moved)], self.scatter.to(speed)
        for number in range(ceil(num_substeps)):
            if drift is not None:
                jacobian = torch.add(jacobian_0, drift[0], alpha=number)
                qacc = torch.add(qacc_smooth, drift[1], alpha=number)
            velocity = self.evaluation.point_velocity(jacobian, speed)
            rising = (velocity * normal).sum(0)  # (P, N)
            if number:
                depth = depth - step * rising
            force = self._contact_force(depth, rising, velocity, normal)
            angles, rates = moved[self.limited_dofs], speed[self.limited_dofs]
            limit = self._limit_force(joints + angles, rates)
            columns = (jacobian * force[:, :, None]).sum(0).flatten(0, 1)  # (P C, N)
            qfrc = matvec(scatter, torch.cat((columns, limit)))
            if self.num_base_dofs:  # forces on the base itself, not through its columns
                qfrc = torch.cat((force.sum(1), qfrc[self.num_base_dofs :]))
            speed = speed + step * (qacc + (inverse * qfrc).sum(1))
            moved = self._composed(moved, step * speed)
            states.append(SubstepState(speed, moved))
        return states

    def to_base_frame(self, qvel: Tensor, rotation: Tensor) -> Tensor:
        """``qvel (nv, N)`` with a floating base's linear part rotated by ``(N, 3, 3)``."""
        if not self.num_base_dofs:
            return qvel
        return torch.cat((_rotated(qvel[:3], rotation), qvel[3:]))

    def _contact_force(
        self, depth: Tensor, rising: Tensor, velocity: Tensor, normal: Tensor
    ) -> Tensor:
        """Forces ``(3, P, N)``, N, on points ``depth (P, N)`` m in the ground, else 0.

        ``rising``: part of ``velocity (3, P, N)``, m/s, along the ground's ``normal``.
        """
        stiffness, damping, slip_damping, friction, share, scale, merged = (
            self.contact_law.to(depth)
        )
        slip = velocity - rising * normal
        slip_speed = (slip.square().sum(0) + MIN_SLIP**2).sqrt()
        spring = stiffness * depth - damping * rising
        stick_force = slip_damping * slip_speed
        on_cone = (scale * (spring + share * stick_force)).clamp_min(0.0)
        on_cone = torch.where(depth > 0.0, on_cone, 0.0)
        normal_force = penalty_law.normal_force(stiffness, damping, depth, rising)
        is_sliding = stick_force > friction * spring
        normal_force = merged * torch.where(is_sliding, on_cone, normal_force)
        sticking = merged * slip_damping
        friction_force = penalty_law.friction_force(
            sticking, friction, normal_force, slip_speed
        )
        return normal_force * normal - (friction_force / slip_speed) * slip

    def _limit_force(self, position: Tensor, velocity: Tensor) -> Tensor:
        """Torques ``(L, N)``, N m or N, of the joints that have limits."""
        stiffness, damping, low, high = self.limit_law.to(position)
        law = stiffness, damping, low, high
        below, above = penalty_law.limit_forces(*law, position, velocity)
        return below.clamp_min(0.0) + above.clamp_max(0.0)

    def _composed(self, moved: Tensor, further: Tensor) -> Tensor:
        """The tangent of two displacements in sequence, to second order."""
        total = moved + further
        if not self.num_base_dofs:
            return total
        twist = 0.5 * cross(moved[3:6], further[3:6])
        return torch.cat((total[:3], total[3:6] + twist, total[6:]))


def state_at(states: list[SubstepState], time: float) -> SubstepState:
    """The state at a time, in substeps; linear between two of them."""
    before = int(time)
    if before == time:
        return states[before]
    pairs = zip(states[before], states[before + 1], strict=True)
    return SubstepState(*(torch.lerp(x, after, time - before) for x, after in pairs))


def _rotated(vectors: Tensor, rotation: Tensor) -> Tensor:
    """``rotation (N, 3, 3)`` applied to ``vectors (3, *size, N)``."""
    rotation = rotation.permute(1, 2, 0).to(vectors)
    rotation = rotation.reshape(3, 3, *[1] * (vectors.ndim - 2), -1)
    return (rotation * vectors).sum(1)


def _expect_one_law(scene: Scene, law: penalty_law.PenaltyLaw) -> None:
    """Refuse points of several bodies that are merged into one but follow other laws."""
    bodies, *_ = shape_points(scene.model, scene.max_contact_points)
    leads = np.array(scene.contacts.stands_for, int)
    own = np.array(bodies, int)[leads >= 0].tolist()
    each, leads = penalty_law.PenaltyLaw.of_bodies(scene.model, own), leads[leads >= 0]
    for name, value in vars(law).items():
        if not np.allclose(getattr(each, name), value[leads]):
            raise ValueError(
                "expected one contact law of shapes that meet in a point, got several in "
                f"scene '{scene.name}'"
            )
