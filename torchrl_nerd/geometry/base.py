"""The frame B_t that a robot's coordinates refer to, and its joint axes as points."""

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import torch
from torch import Tensor, nn

from torchrl_nerd.geometry.manifold import FREE, HINGE, SLIDE
from torchrl_nerd.geometry.rotations import matrix_from_quat, quat_matrix


# a scene keeps them: they must not be inference tensors, whoever asks first
@torch.inference_mode(False)
def keep_constants(module: nn.Module, dtype: Any = np.float64, **values: Any) -> None:
    """Keep copies as buffers: they move with the module, checkpoints omit them."""
    for name, value in values.items():
        tensor = torch.from_numpy(np.array(value, dtype, order="C"))
        module.register_buffer(name, tensor, persistent=False)


def keep_indices(module: nn.Module, **values: Any) -> None:
    """Keep integers as buffers: `torch.compile` would guard every entry of a list."""
    keep_constants(module, np.int64, **values)


@dataclass(frozen=True)
class Base:
    """The body whose pose defines B_t.

    A floating base is the body of the free joint. A fixed base is the pose,
    constant in the world, of the first moving body's frame before its joints move. Of
    several moving trees the robot is that which most actuators drive, the first of equals;
    ``others`` are the root bodies of the rest: props, and further robots.
    """

    body: int
    is_floating: bool
    qpos_address: int = 0
    dof_address: int = 0
    others: tuple[int, ...] = ()

    @classmethod
    def from_model(cls, model: mujoco.MjModel) -> "Base":
        """Find the base; a ValueError where nothing in the model can move."""
        if not model.njnt:
            raise ValueError("no joint")
        roots = [model.body_treeid.tolist().index(tree) for tree in range(model.ntree)]
        drives = np.zeros(model.ntree, int)
        if model.nu and model.ntree > 1:
            data = mujoco.MjData(model)
            mujoco.mj_fwdPosition(model, data)
            dofs = data.moment_colind[: data.moment_rownnz.sum()]
            actuators = np.repeat(np.arange(model.nu), data.moment_rownnz)
            # an actuator counts once for a tree, however many of its dofs it moves
            pairs = np.stack((actuators, model.dof_treeid[dofs]))
            trees = np.unique(pairs, axis=1)[1]
            drives = np.bincount(trees, minlength=model.ntree)
        root = roots[int(drives.argmax())]
        others = tuple(body for body in roots if body != root)
        if not is_free(model, root):
            return cls(root, False, others=others)
        joint = int(model.body_jntadr[root])
        q, v = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
        return cls(root, True, q, v, others)


def is_free(model: mujoco.MjModel, body: int) -> bool:
    """Whether a body that moves has a free joint."""
    return bool(model.jnt_type[model.body_jntadr[body]] == FREE)


def ancestors(model: mujoco.MjModel) -> np.ndarray:
    """Which bodies each hangs on, itself and the world too, ``(nbody, nbody)``, bool."""
    found = np.eye(model.nbody, dtype=bool)
    for body in range(1, model.nbody):  # parents come first
        found[body] |= found[model.body_parentid[body]]
    return found


def root_pose(model: mujoco.MjModel, body: int) -> tuple[np.ndarray, np.ndarray]:
    """Where a tree's root body stands before its joints move.

    World position ``(3,)``, m, and rotation ``(3, 3)``.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    parent = int(model.body_parentid[body])
    rotation = data.xmat[parent].reshape(3, 3)
    position = data.xpos[parent] + rotation @ model.body_pos[body]
    return position, rotation @ quat_matrix(model.body_quat[body])


class BasePose(nn.Module):
    """World position and rotation of the base frame B_t of a compiled model."""

    position: Tensor
    rotation: Tensor

    def __init__(self, model: mujoco.MjModel, base: Base) -> None:
        super().__init__()
        self.base = base
        position, rotation = root_pose(model, base.body)
        keep_constants(self, position=position, rotation=rotation)

    def forward(self, qpos: Tensor) -> tuple[Tensor, Tensor]:
        """Position ``(*batch, 3)``, m, and rotation ``(*batch, 3, 3)`` for ``qpos``."""
        if not self.base.is_floating:
            batch = qpos.shape[:-1]
            return self.position.expand(*batch, 3), self.rotation.expand(*batch, 3, 3)
        q = self.base.qpos_address
        return qpos[..., q : q + 3], matrix_from_quat(qpos[..., q + 3 : q + 7])


def over_ground(
    base: Base, qvel: Tensor, points: Tensor, velocity: Tensor, rotation: Tensor
) -> Tensor:
    """Velocities of points in the world, m/s, in the axes of B_t.

    From ``qvel (*batch, nv)``, and in B_t: positions of the ``points (*batch, P, 3)``, m,
    and their ``velocity`` relative to the base, whose ``rotation`` is ``(*batch, 3, 3)``.
    """
    if not base.is_floating:
        return velocity
    v = base.dof_address
    linear = (rotation.mT @ qvel[..., v : v + 3, None])[..., 0]  # (*batch, 3)
    angular = qvel[..., None, v + 3 : v + 6].expand_as(velocity)
    return velocity + linear[..., None, :] + torch.linalg.cross(angular, points)


@dataclass(frozen=True, eq=False)
class JointAxes:
    """The J hinges and slides of a robot whose bodies have at most one joint each.

    The anchor and the tip of every axis are points for `PointKinematics` to find.
    """

    joints: list[int]  # ids, in the order of their dofs
    bodies: list[int]  # of the points: all anchors, then all tips
    positions: np.ndarray  # (2 J, 3), m, in the body's frame
    is_slide: np.ndarray  # (J,): 1 for a slide, 0 for a hinge
    ancestry: np.ndarray  # (J, bodies of the model): 1 where one moves with a joint

    @classmethod
    def of(cls, model: mujoco.MjModel, base: Base) -> "JointAxes":
        """Read them from a compiled model.

        Raises:
            ValueError: a ball joint, several joints of one body, or several moving trees.
        """
        if base.others:
            raise ValueError(
                f"expected one moving tree for the equation of motion, got "
                f"{1 + len(base.others)}"
            )
        joints = [j for j in range(model.njnt) if model.jnt_type[j] in (HINGE, SLIDE)]
        if len(joints) + base.is_floating < model.njnt or (model.body_jntnum > 1).any():
            raise ValueError(
                "expected hinges and slides, one to a body, for the equation of motion, "
                "got others"
            )
        anchor, axis = model.jnt_pos[joints], model.jnt_axis[joints]
        positions = np.concatenate((anchor, anchor + axis))
        is_slide = (model.jnt_type[joints] == SLIDE).astype(np.float64)
        moved = model.jnt_bodyid[joints]
        ancestry = ancestors(model)[:, moved].T.astype(np.float64)
        return cls(joints, 2 * moved.tolist(), positions, is_slide, ancestry)
