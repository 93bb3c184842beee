"""An isometry of a robot: what it makes of states and of what drives the robot."""

import mujoco
import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor, nn

from torchrl_nerd.geometry.base import keep_constants, keep_indices
from torchrl_nerd.geometry.rotations import quat_multiply
from torchrl_nerd.keys import (
    CTRL,
    JOINT_TORQUE,
    NEXT_QPOS,
    NEXT_QVEL,
    PARAMETERS,
    QPOS,
    QVEL,
)

MIRROR = np.diag((1.0, -1.0, 1.0))  # of the world, where the base is mirrored

Permutation = tuple[np.ndarray, np.ndarray]
"""Sources ``(n,)`` of numbers, and their signs ``(n,)``."""


class Isometry(nn.Module):
    """A map of states, torques and servos' controls that commutes with the dynamics.

    Args:
        body: ``(3, 3)``, of vectors in the axes of the floating base. Where it is a
            reflection, the world is mirrored as well, so that the base stays a rotation.
            None for a fixed base.
        sources: ``(nv,)``: dof v of the copy is sign times dof source.
        signs: ``(nv,)``.
        actuated: dofs with a motor, in the order of torques.
        controls: of servos, sources and signs ``(nu,)`` of their controls.
    """

    world: Tensor
    mirror: Tensor
    turn: Tensor
    axial: Tensor
    joint_sources: Tensor
    joint_signs: Tensor
    motors: Tensor
    motor_signs: Tensor
    ctrl_sources: Tensor
    ctrl_signs: Tensor

    def __init__(
        self,
        body: np.ndarray | None,
        sources: np.ndarray,
        signs: np.ndarray,
        actuated: list[int],
        controls: Permutation | None = None,
    ) -> None:
        super().__init__()
        self.base = (0, 0) if body is None else (7, 6)  # its part of qpos and qvel
        dofs = self.base[1]
        motors = [actuated.index(source) for source in sources[actuated]]
        keep_indices(self, joint_sources=sources[dofs:] - dofs, motors=motors)
        keep_constants(self, joint_signs=signs[dofs:], motor_signs=signs[actuated])
        if controls is not None:
            keep_indices(self, ctrl_sources=controls[0])
            keep_constants(self, ctrl_signs=controls[1])
        if body is None:
            return
        parity = np.linalg.det(body)
        world, mirror = np.eye(3), np.ones(4)
        if parity < 0.0:  # axes of rotations in the mirror's plane flip: they are axial
            world, mirror = MIRROR, np.array((1.0, -1.0, 1.0, -1.0))
        turn = np.empty(4)
        mujoco.mju_mat2Quat(turn, (world @ body.T).reshape(-1))
        keep_constants(self, world=world, mirror=mirror, turn=turn, axial=parity * body)

    def qpos(self, qpos: Tensor) -> Tensor:
        """Symmetric copy of positions ``(*batch, nq)``."""
        joints = self.joints(qpos[..., self.base[0] :])
        if not any(self.base):
            return joints
        position, quat = qpos[..., :3] @ self.world.mT, qpos[..., 3:7] * self.mirror
        return torch.cat((position, quat_multiply(quat, self.turn), joints), -1)

    def joints(self, values: Tensor) -> Tensor:
        """Symmetric copy of positions or velocities of joints ``(*batch, joints)``."""
        return values[..., self.joint_sources] * self.joint_signs

    def qvel(self, qvel: Tensor) -> Tensor:
        """Symmetric copy of velocities ``(*batch, nv)``."""
        joints = self.joints(qvel[..., self.base[1] :])
        if not any(self.base):
            return joints
        linear, angular = qvel[..., :3] @ self.world.mT, qvel[..., 3:6] @ self.axial.mT
        return torch.cat((linear, angular, joints), -1)

    def torque(self, joint_torque: Tensor) -> Tensor:
        """Symmetric copy of joint torques ``(*batch, num_actuated)``."""
        return joint_torque[..., self.motors] * self.motor_signs

    def ctrl(self, ctrl: Tensor) -> Tensor:
        """Symmetric copy of servos' controls ``(*batch, nu)``."""
        return ctrl[..., self.ctrl_sources] * self.ctrl_signs.to(ctrl)

    def forward(self, data: TensorDict) -> TensorDict:
        """Symmetric copy of states or transitions: of every key that is there.

        Parameters stay: it is the same robot.
        """
        maps = {QPOS: self.qpos, QVEL: self.qvel, JOINT_TORQUE: self.torque}
        maps[CTRL] = self.ctrl
        maps |= {NEXT_QPOS: self.qpos, NEXT_QVEL: self.qvel, PARAMETERS: nn.Identity()}
        keys = data.keys(True)
        copy = {key: apply(data[key]) for key, apply in maps.items() if key in keys}
        return TensorDict(copy, data.batch_size)
