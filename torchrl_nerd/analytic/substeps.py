"""Substeps of contact and limit forces while the rest of the dynamics is frozen.

MuJoCo's substeps, but for what changes little within a control step: the contact Jacobian
and the smooth acceleration change linearly from one `FrozenDynamics` to another, and the
mass matrix is that of the second one.
"""

from math import ceil
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from torchrl_nerd.analytic.frozen_dynamics import DynamicsEvaluation, FrozenDynamics
from torchrl_nerd.analytic.penalty_forces import PenaltyContactForce, PenaltyLimitForce
from torchrl_nerd.geometry.base import JointAxes, keep_constants
from torchrl_nerd.geometry.kinematics import cross
from torchrl_nerd.geometry.spd import matvec
from torchrl_nerd.scenes.scene import Scene


class SubstepState(NamedTuple):
    """Velocity and displacement since the start of the step; batch last."""

    qvel: Tensor  # (nv, N)
    moved: Tensor  # (nv, N), a tangent of qpos

    def lerp(self, other: "SubstepState", share: float) -> "SubstepState":
        """A share of the way to another one."""
        pairs = zip(self, other, strict=True)
        return SubstepState(*(torch.lerp(one, end, share) for one, end in pairs))


class SubstepIntegrator(nn.Module):
    """Integrates a robot under penalty contact and limit forces.

    Args:
        scene: whose contacts and limits follow the penalty law.
        axes: its joints.
        evaluation: what made the frozen dynamics.
        step_size: s, of a substep.
        stage_offset: when forces act in a substep, as a share of it: 0 for semi-implicit
            Euler, 0.5 for leapfrog.

    Raises:
        ValueError: contacts or limits of another law.
    """

    limited_dofs: Tensor
    limited_qpos: Tensor
    scatter: Tensor

    def __init__(
        self,
        scene: Scene,
        axes: JointAxes,
        evaluation: DynamicsEvaluation,
        step_size: float,
        stage_offset: float,
    ) -> None:
        super().__init__()
        self.step_size, self.stage_offset = step_size, stage_offset
        self.evaluation = evaluation
        self.num_base_dofs = evaluation.num_base_dofs
        self.contact = PenaltyContactForce(scene)
        self.limit = PenaltyLimitForce(scene.model, axes)
        limited = [2 * self.num_base_dofs + joint for joint in self.limit.joints]
        dofs = [*evaluation.jacobian_dofs.tolist(), *limited]
        scatter = np.zeros((scene.model.nv, len(dofs)))  # adds columns to their dofs
        scatter[np.array(dofs, int), range(len(dofs))] = 1.0
        addresses = evaluation.rigid_body.qpos_addresses
        limited_qpos = [addresses[joint] for joint in self.limit.joints]
        for name, numbers in (
            ("limited_dofs", limited),
            ("limited_qpos", limited_qpos),
        ):
            index = torch.from_numpy(np.array(numbers, dtype=np.int64))
            self.register_buffer(name, index, persistent=False)
        keep_constants(self, scatter=scatter)

    def integrate_substeps(
        self,
        first: FrozenDynamics,
        last: FrozenDynamics,
        between: float,
        qpos: Tensor,
        qvel: Tensor,
        num_substeps: float,
    ) -> list[SubstepState]:
        """Integrate the substeps from the given state; return the state after each.

        Args:
            first: dynamics from which Jacobian and smooth acceleration change linearly
            last: to these; the result is in the base frame of ``last``.
            between: time between both, in substeps; 0: they are one, nothing changes.
            qpos: at the start, ``(N, nq)``.
            qvel: at the start, ``(N, nv)``.
            num_substeps: time to reach, in substeps; rounded up.

        Returns:
            The state at the start and after each substep.
        """
        step, jacobian, normal, depth, qacc_smooth, inverse, _ = self.step_size, *last
        joints = qpos.mT[self.limited_qpos].to(qacc_smooth)
        speed = self.to_base_frame(qvel.mT, last.rotation.mT).to(qacc_smooth)
        jacobian_rate, qacc_rate = None, None
        if between:
            turn = last.rotation.mT @ first.rotation
            jacobian, normal = (
                _rotated(x, turn) for x in (first.jacobian, first.normal)
            )
            qacc_smooth = self.to_base_frame(first.qacc_smooth, turn)
            depth, rate = first.depth, 1.0 / between  # per substep
            jacobian_rate = rate * (last.jacobian - jacobian)
            qacc_rate = rate * (last.qacc_smooth - qacc_smooth)
        jacobian_0, moved = jacobian, torch.zeros_like(speed)
        change = moved
        states, scatter = [SubstepState(speed, moved)], self.scatter.to(speed)
        for number in range(ceil(num_substeps)):
            time = number + self.stage_offset
            if jacobian_rate is not None:
                jacobian = torch.add(jacobian_0, jacobian_rate, alpha=time)
            velocity = self.evaluation.point_velocity(jacobian, speed)
            rising = (velocity * normal).sum(0)
            if time:
                depth = depth - min(1.0, time) * step * rising
            damped = speed
            if self.stage_offset:
                moved = self._composed(moved, self.stage_offset * step * speed)
                damped = speed + self.stage_offset * change  # extrapolated to the stage
                velocity = self.evaluation.point_velocity(jacobian, damped)
                rising = (velocity * normal).sum(0)
            slip = velocity - rising * normal
            force = self.contact(depth, rising, slip, normal)
            limit = self.limit(
                joints + moved[self.limited_dofs], damped[self.limited_dofs]
            )
            columns = (jacobian * force[:, :, None]).sum(0).flatten(0, 1)
            qfrc = matvec(scatter, torch.cat((columns, limit)))
            if self.num_base_dofs:
                qfrc = torch.cat((force.sum(1), qfrc[self.num_base_dofs :]))
            qacc = qacc_smooth
            if qacc_rate is not None:
                qacc = torch.add(qacc_smooth, qacc_rate, alpha=time)
            change = step * (qacc + (inverse * qfrc).sum(1))
            speed = speed + change
            moved = self._composed(moved, (1.0 - self.stage_offset) * step * speed)
            states.append(SubstepState(speed, moved))
        return states

    def to_base_frame(self, qvel: Tensor, rotation: Tensor) -> Tensor:
        """``qvel (nv, N)`` with a floating base's linear part rotated by ``(N, 3, 3)``."""
        if not self.num_base_dofs:
            return qvel
        return torch.cat((_rotated(qvel[:3], rotation), qvel[3:]))

    def _composed(self, moved: Tensor, further: Tensor) -> Tensor:
        """The tangent of two displacements in sequence, to second order."""
        total = moved + further
        if not self.num_base_dofs:
            return total
        angular = slice(self.num_base_dofs, 2 * self.num_base_dofs)
        twist = 0.5 * cross(moved[angular], further[angular])
        return torch.cat(
            (total[: self.num_base_dofs], total[angular] + twist, total[6:])
        )


def state_at(states: list[SubstepState], time: float) -> SubstepState:
    """The state at a time, in substeps; linear between two of them."""
    before = int(time)
    if before == time:
        return states[before]
    return states[before].lerp(states[before + 1], time - before)


def _rotated(vectors: Tensor, rotation: Tensor) -> Tensor:
    """``rotation (N, 3, 3)`` applied to ``vectors (3, *size, N)``."""
    rotation = rotation.permute(1, 2, 0).to(vectors)
    rotation = rotation.reshape(3, 3, *[1] * (vectors.ndim - 2), -1)
    return (rotation * vectors).sum(1)
