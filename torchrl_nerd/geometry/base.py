"""The frame B_t that a robot's coordinates refer to, and its joint axes as points."""

from dataclasses import dataclass

import mujoco
import numpy as np
import torch
from torch import Tensor, nn

from torchrl_nerd.geometry.manifold import FREE, HINGE, SLIDE
from torchrl_nerd.geometry.rotations import matrix_from_quat, quat_matrix


# a scene keeps them: they must not be inference tensors, whoever asks first
@torch.inference_mode(False)
def keep_constants(module: nn.Module, **values: object) -> None:
    """Keep copies as float64 buffers: they move with the module, checkpoints omit them."""
    for name, value in values.items():
        tensor = torch.from_numpy(np.asarray(value, np.float64).copy())
        module.register_buffer(name, tensor, persistent=False)


@torch.inference_mode(False)
def keep_indices(module: nn.Module, **values: object) -> None:
    """Keep integers as buffers: `torch.compile` would guard every entry of a list."""
    for name, value in values.items():
        tensor = torch.from_numpy(np.asarray(value, np.int64).copy())
        module.register_buffer(name, tensor, persistent=False)


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
        weld = model.body_weldid
        roots = [
            body
            for body in range(1, model.nbody)
            if model.body_dofnum[body] > 0 and weld[body] == body
            if weld[model.body_parentid[body]] == 0
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
    """World position ``(3,)``, m, and rotation ``(3, 3)`` of a fixed base."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    parent = int(model.body_parentid[base.body])
    rotation = data.xmat[parent].reshape(3, 3)
    position = data.xpos[parent] + rotation @ model.body_pos[base.body]
    return position, rotation @ quat_matrix(model.body_quat[base.body])


class BasePose(nn.Module):
    """World position and rotation of the base frame B_t of a compiled model."""

    position: Tensor
    rotation: Tensor

    def __init__(self, model: mujoco.MjModel, base: Base) -> None:
        super().__init__()
        self.base = base
        position, rotation = fixed_base_pose(model, base)
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

    model: mujoco.MjModel
    joints: list[int]  # ids, in the order of their dofs
    bodies: list[int]  # of the points: all anchors, then all tips
    positions: np.ndarray  # (2 J, 3), m, in the body's frame
    is_slide: np.ndarray  # (J,): 1 for a slide, 0 for a hinge

    @classmethod
    def of(cls, model: mujoco.MjModel, base: Base) -> "JointAxes":
        """Read them from a compiled model.

        Raises:
            ValueError: a ball joint, or several joints of one body.
        """
        joints = [j for j in range(model.njnt) if model.jnt_type[j] in (HINGE, SLIDE)]
        if len(joints) + base.is_floating < model.njnt or (model.body_jntnum > 1).any():
            raise ValueError(
                "expected hinges and slides, one to a body, for the equation of motion, "
                "got others"
            )
        anchor, axis = model.jnt_pos[joints], model.jnt_axis[joints]
        positions = np.concatenate((anchor, anchor + axis))
        is_slide = (model.jnt_type[joints] == SLIDE).astype(np.float64)
        return cls(
            model, joints, 2 * model.jnt_bodyid[joints].tolist(), positions, is_slide
        )

    def ancestry(self, bodies: list[int]) -> np.ndarray:
        """``(J, len(bodies))``: 1 where a body moves with a joint, else 0."""
        moved = self.bodies[: len(self.joints)]
        below = [[_is_below(self.model, body, top) for body in bodies] for top in moved]
        return np.array(below, dtype=np.float64).reshape(len(moved), len(bodies))


def _is_below(model: mujoco.MjModel, body: int, ancestor: int) -> bool:
    while body > ancestor:  # parents come first
        body = int(model.body_parentid[body])
    return body == ancestor
