"""Moving trees beside the robot: props, as its base sees them."""

import mujoco
import torch
from torch import Tensor, nn

from torchrl_nerd.geometry.base import Base, BasePose, is_free, root_pose
from torchrl_nerd.geometry.motion import Motion, cross, keep, matmul, rotate_by
from torchrl_nerd.geometry.rotations import matrix_from_quat, quat_normalize


class OtherTrees(nn.Module):
    """Motion of the roots of the moving trees beside the robot's, as seen from B_t.

    A free body's own motion; of a tree that stands in the world, that of its place.
    """

    position: Tensor  # (3, n, 1), m, world, of those that stand
    rotation: Tensor  # (3, 3, n, 1)

    def __init__(self, model: mujoco.MjModel, base: Base) -> None:
        super().__init__()
        self.base, self.pose = base, BasePose(model, base)
        self.addresses: list[tuple[int, int] | None] = []
        for root in base.others:
            joint = int(model.body_jntadr[root])
            at = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
            self.addresses.append(at if is_free(model, root) else None)
        places, turns = zip(*(root_pose(model, r) for r in base.others), strict=True)
        keep(self, position=places, rotation=turns)

    def forward(self, qpos: Tensor, qvel: Tensor) -> Motion:
        """From ``qpos (nq, N)`` and ``qvel (nv, M)``, of all robots or the first M."""
        moving = slice(qvel.shape[-1])
        place, turn = self.pose(qpos.T)
        place, inverse = place.T[:, None], turn.permute(2, 1, 0)[:, :, None]
        zero = qvel.new_zeros(3, qvel.shape[-1])
        motions = []
        for i, address in enumerate(self.addresses):
            position = self.position[:, i].expand(3, qpos.shape[-1])
            rotation = self.rotation[:, :, i].expand(3, 3, qpos.shape[-1])
            linear = spin = zero
            if address is not None:
                q, v = address
                position = qpos[q : q + 3]
                quat = quat_normalize(qpos[q + 3 : q + 7].T)
                rotation = matrix_from_quat(quat).permute(1, 2, 0)
                linear, spin = qvel[v : v + 3], qvel[v + 3 : v + 6]
            motions.append((position, rotation, spin, linear))
        world, axes, spin, linear = (
            torch.stack(same, -2) for same in zip(*motions, strict=True)
        )  # (3, n, N), (3, 3, n, N), ...
        position = rotate_by(inverse, world - place)
        rotation = matmul(inverse, axes)
        spin = rotate_by(rotation[..., moving], spin)
        linear = rotate_by(inverse[..., moving], linear)
        if self.base.is_floating:
            v = self.base.dof_address
            own, turning = qvel[v : v + 3, None], qvel[v + 3 : v + 6, None]
            linear = linear - rotate_by(inverse[..., moving], own)
            linear = linear - cross(turning.expand_as(spin), position[..., moving])
            spin = spin - turning
        return position, rotation, spin, linear
