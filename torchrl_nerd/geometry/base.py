"""Which body a robot's own frame B_t rides on, and where that frame is."""

from dataclasses import dataclass

import mujoco
import numpy as np
import torch
from torch import Tensor, nn

from torchrl_nerd.geometry.constants import keep_constants
from torchrl_nerd.geometry.manifold import FREE
from torchrl_nerd.geometry.rotations import matrix_from_quat, quat_matrix


@dataclass(frozen=True)
class Base:
    """The body whose pose defines B_t.

    A floating base is the body of the free joint. A fixed base is the pose,
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


def fixed_base_pose(model: mujoco.MjModel, base: Base) -> tuple[np.ndarray, np.ndarray]:
    """World position ``(3,)`` and rotation ``(3, 3)`` of a fixed base's mount."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    parent = int(model.body_parentid[base.body])
    rotation = data.xmat[parent].reshape(3, 3)
    position = data.xpos[parent] + rotation @ model.body_pos[base.body]
    return position, rotation @ quat_matrix(model.body_quat[base.body])


def base_pose(
    base: Base, qpos: Tensor, mount_position: Tensor, mount_rotation: Tensor
) -> tuple[Tensor, Tensor]:
    """World position ``(*batch, 3)`` and rotation ``(*batch, 3, 3)`` of B_t.

    Args:
        base: floating, read from ``qpos (*batch, nq)``, or fixed, where its mount is.
        qpos: of the robot.
        mount_position: ``(3,)``, m, world.
        mount_rotation: ``(3, 3)``.
    """
    if not base.is_floating:
        batch = qpos.shape[:-1]
        return mount_position.expand(*batch, 3), mount_rotation.expand(*batch, 3, 3)
    q = base.qpos_address
    return qpos[..., q : q + 3], matrix_from_quat(qpos[..., q + 3 : q + 7])


class BasePose(nn.Module):
    """`base_pose` of one robot.

    Args:
        base: of the robot.
        mount: position ``(3,)``, m, and rotation ``(3, 3)``, see `fixed_base_pose`.
    """

    position: Tensor
    rotation: Tensor

    def __init__(self, base: Base, mount: tuple[np.ndarray, np.ndarray]) -> None:
        super().__init__()
        self.base = base
        keep_constants(self, position=mount[0], rotation=mount[1])

    def forward(self, qpos: Tensor) -> tuple[Tensor, Tensor]:
        """Position ``(*batch, 3)`` and rotation ``(*batch, 3, 3)`` for ``qpos``."""
        return base_pose(self.base, qpos, self.position, self.rotation)


def over_ground(
    base: Base, qvel: Tensor, points: Tensor, velocity: Tensor, rotation: Tensor
) -> Tensor:
    """Velocities ``(*batch, P, 3)`` over the ground of points that the base carries.

    Args:
        base: of the robot.
        qvel: ``(*batch, nv)``.
        points: ``(*batch, P, 3)``, m, as all that follows in B_t.
        velocity: as seen by one who rides on the base, ``(*batch, P, 3)``, m/s.
        rotation: of the base, ``(*batch, 3, 3)``.
    """
    if not base.is_floating:
        return velocity
    v = base.dof_address
    linear = (rotation.mT @ qvel[..., v : v + 3, None])[..., 0]
    angular = qvel[..., None, v + 3 : v + 6].expand_as(velocity)
    return velocity + linear[..., None, :] + torch.linalg.cross(angular, points)
