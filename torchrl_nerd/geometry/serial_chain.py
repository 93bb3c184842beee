"""A site at the end of a chain of joints: its pose, Jacobian and bias acceleration.

The chain is pytorch-kinematics' `SerialChain`, built from a compiled MuJoCo model.
Source: https://github.com/UM-ARM-Lab/pytorch_kinematics
"""

import copy
from typing import TYPE_CHECKING, Any, NamedTuple

import mujoco
import numpy as np
import torch
from torch import Tensor

from torchrl_nerd.geometry.base import ancestors
from torchrl_nerd.geometry.constants import take
from torchrl_nerd.geometry.manifold import HINGE, SLIDE, body_joints
from torchrl_nerd.geometry.rotations import quat_matrix

if TYPE_CHECKING:  # importing it takes a second: only who builds a chain waits for it
    from pytorch_kinematics import SerialChain
    from pytorch_kinematics.frame import Frame

END = "end"


class EndEffector(NamedTuple):
    """Where a site is, and how the n joints of its chain move it; all in the world."""

    position: Tensor  # (*batch, 3), m
    rotation: Tensor  # (*batch, 3, 3)
    jacobian: Tensor  # (*batch, 6, n): velocity, then angular velocity, per joint rate


class SiteKinematics:
    """Forward kinematics and Jacobian of a named site on a robot whose base is fixed.

    ``qpos_addresses`` and ``dof_addresses`` are those of the chain's n joints, from the
    base on.

    Raises:
        ValueError: no such site, or a joint on the way to it that is no hinge or slide.
    """

    def __init__(self, model: mujoco.MjModel, site: str) -> None:
        bodies = _bodies_to(model, site)
        joints = [joint for body in bodies for joint in body_joints(model, body)]
        others = [j for j in joints if model.jnt_type[j] not in (HINGE, SLIDE)]
        if others or not joints:
            found = f"joint '{model.joint(others[0]).name}'" if others else "no joint"
            raise ValueError(
                f"expected hinges and slides on the way to site '{site}', got {found}"
            )
        self.qpos_addresses = model.jnt_qposadr[joints].tolist()
        self.dof_addresses = model.jnt_dofadr[joints].tolist()
        self._chains = {torch.device("cpu"): _serial_chain(model, site, bodies)}

    def __call__(self, qpos: Tensor) -> EndEffector:
        """Pose and Jacobian at ``qpos (*batch, nq)``, in the dtype of ``qpos``."""
        batch, chain = qpos.shape[:-1], self._chain(qpos.device)
        joints = qpos.reshape(batch.numel(), qpos.shape[-1])
        joints = take(joints, self.qpos_addresses)
        jacobian, pose = chain.jacobian_tensor(joints.double(), ret_eef_pose=True)
        parts = (x.to(qpos.dtype) for x in (pose[:, :3, 3], pose[:, :3, :3], jacobian))
        return EndEffector(*(x.reshape(*batch, *x.shape[1:]) for x in parts))

    def _chain(self, device: torch.device) -> "SerialChain":
        if device not in self._chains:
            with torch.inference_mode(False):
                first = copy.deepcopy(self._chains[torch.device("cpu")])
                self._chains[device] = first.to(device=device)
        return self._chains[device]


def bias_acceleration(jacobian: Tensor, rates: Tensor) -> Tensor:
    """Acceleration of a site at constant joint rates, ``(*batch, 6)``.

    The time derivative of the Jacobian times the rates: linear, then angular. It follows
    from the Jacobian, since its columns are the joints' twists about the site. With
    omega_j and v_j the sums of the columns up to joint j times their rates:

        angular = sum_j omega_j x (J_w,j q_j')
        linear = sum_j (omega_j x (J_v,j q_j') + v_j x (J_w,j q_j')) + omega_n x v_n

    ``jacobian (*batch, 6, n)`` is that of `EndEffector`, ``rates (*batch, n)`` those of the
    joints. Source: Featherstone, Rigid Body Dynamics Algorithms, section 2.11.
    """
    twists = (jacobian * rates[..., None, :]).mT  # (*batch, n, 6)
    moved, turned = twists.split(3, -1)
    velocity, omega = twists.cumsum(-2).split(3, -1)
    cross = torch.linalg.cross
    angular = cross(omega, turned).sum(-2)
    linear = (cross(omega, moved) + cross(velocity, turned)).sum(-2)
    linear = linear + cross(omega[..., -1, :], velocity[..., -1, :])
    return torch.cat((linear, angular), -1)


@torch.inference_mode(False)
def _serial_chain(model: mujoco.MjModel, site: str, bodies: list[int]) -> "SerialChain":
    """pytorch-kinematics' chain from the world to a site, float64; its joints take qpos."""
    from pytorch_kinematics import Chain, SerialChain

    root = last = make_frame("world", np.eye(4))
    offset = np.eye(4)
    for body in bodies:
        last, offset = add_body(model, body, last, offset)
    place = model.site(site)
    end = make_frame(END, offset @ _matrix(place.pos, place.quat))
    last.children = [end]
    float64: dict[str, Any] = {"dtype": torch.float64}
    return SerialChain(Chain(root, **float64), END, **float64)


def make_frame(name: str, offset: np.ndarray, **joint: Any) -> "Frame":
    """A frame of pytorch-kinematics, ``offset (4, 4)`` in its parent before it moves."""
    from pytorch_kinematics.frame import Frame, Joint, Link
    from pytorch_kinematics.transforms import Transform3d

    place = Transform3d(matrix=torch.from_numpy(offset[None]), dtype=torch.float64)
    return Frame(name, Link(name, place), Joint(name, dtype=torch.float64, **joint))


def add_body(
    model: mujoco.MjModel, body: int, last: "Frame", offset: np.ndarray
) -> tuple["Frame", np.ndarray]:
    """Add a frame for each hinge and slide of a body, at the joint's anchor.

    Its parent stands at ``offset (4, 4)`` in the frame ``last``. Returns the frame that the
    body moves with, and the body in it. MuJoCo's ``ref`` is in these offsets.
    """
    offset = offset @ _matrix(model.body_pos[body], model.body_quat[body])
    for joint in body_joints(model, body):
        axis, anchor = model.jnt_axis[joint], model.jnt_pos[joint]
        is_hinge, quat = model.jnt_type[joint] == HINGE, np.array([1.0, 0.0, 0.0, 0.0])
        ref = model.qpos0[model.jnt_qposadr[joint]]
        if is_hinge:
            mujoco.mju_axisAngle2Quat(quat, axis, -ref)
        shift = anchor - ref * axis * (not is_hinge)
        frame = make_frame(
            f"joint {joint}",
            offset @ _matrix(shift, quat),
            joint_type="revolute" if is_hinge else "prismatic",
            axis=torch.from_numpy(axis.copy()),
            limits=tuple(model.jnt_range[joint]) if model.jnt_limited[joint] else None,
        )
        last.children = [*last.children, frame]
        last, offset = frame, _matrix(-anchor)
    return last, offset


def _matrix(position: np.ndarray, quat: np.ndarray | None = None) -> np.ndarray:
    """A homogeneous transform ``(4, 4)``."""
    matrix = np.eye(4)
    matrix[:3, 3] = position
    if quat is not None:
        matrix[:3, :3] = quat_matrix(quat)
    return matrix


def _bodies_to(model: mujoco.MjModel, site: str) -> list[int]:
    """Bodies from the world, which is not among them, to the site's."""
    names = [model.site(index).name for index in range(model.nsite)]
    if site not in names:
        known = ", ".join(filter(None, names)) or "none"
        raise ValueError(f"expected the name of a site ({known}), got {site!r}")
    return np.flatnonzero(ancestors(model)[model.site(site).bodyid[0]])[1:].tolist()
