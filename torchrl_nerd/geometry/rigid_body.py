"""Rigid-body dynamics without contact: mass matrix, bias forces, acceleration.

A rigid body has the same inertia as four points of a quarter of its mass each, at the even
corners of a box about its centre. From the positions of these points and of the joint axes
follow the mass matrix (composite rigid bodies) and the bias forces (Newton-Euler), in the
base frame, batched.
Source: Featherstone, Rigid Body Dynamics Algorithms, chapters 5 and 6.
"""

from typing import Any, NamedTuple

import mujoco
import numpy as np
import torch
from torch import Tensor, nn

from torchrl_nerd.geometry.base import Base, JointAxes, keep_constants
from torchrl_nerd.geometry.constants import take
from torchrl_nerd.geometry.motion import cross
from torchrl_nerd.geometry.rotations import quat_matrix
from torchrl_nerd.geometry.spd import matvec, spd_solve

CORNERS = np.array([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)], float)


class _Inertia(NamedTuple):
    """Mass ``(n, 1)`` and its moments about the base frame's origin, rows last."""

    mass: Tensor
    first: Tensor  # (3, n, N)
    second: Tensor  # (3, 3, n, N)

    def momentum(self, spin: Tensor, slide: Tensor) -> tuple[Tensor, Tensor]:
        """Angular and linear, of bodies that turn and move so, ``(3, n, N)``."""
        trace = self.second[0, 0] + self.second[1, 1] + self.second[2, 2]
        angular = trace * spin - (self.second * spin).sum(1) + cross(self.first, slide)
        return angular, self.mass * slide + cross(spin, self.first)


FORCES = sum(
    int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}"))
    for name in (
        *("GRAVITY", "SPRING", "DAMPER", "EULERDAMP"),
        *("LIMIT", "CONSTRAINT", "ACTUATION"),
    )
)
"""Flags of MuJoCo that switch off forces which the equation of motion has."""


def other_forces(model: mujoco.MjModel) -> dict[str, Any]:
    """Forces of MuJoCo that `RigidBodyDynamics` leaves out, true where there are any."""
    names = ("armature", "damping", "dampingpoly")
    polynomials = model.jnt_stiffnesspoly, model.dof_dampingpoly
    of_actuators = (getattr(model, f"actuator_{name}") for name in names)
    return {
        "dry friction": model.dof_frictionloss.any(),
        "air or water": model.opt.density or model.opt.viscosity,
        "equality constraints": model.neq,
        "tendons": model.ntendon,
        "gravity compensation": model.body_gravcomp.any(),
        "actuators with damping or mass": any(x.any() for x in of_actuators),
        "stiffness or damping that grows": any(x.any() for x in polynomials),
        "forces switched off": model.opt.disableflags & FORCES,
    }


class RigidBodyDynamics(nn.Module):
    """Acceleration of a robot without contacts and limits; ``actuated``: driven dofs.

    It needs the points ``positions (2 J + 4 B, 3)``, m, in the frames of ``bodies``: the
    anchors, then the tips of all joint axes, then four points of each body with mass.

    Raises:
        ValueError: a moving body of inertia without mass.
    """

    mass: Tensor  # (B, 1), kg
    ancestry: Tensor  # (nv, B): 1 where a body moves with a dof
    together: Tensor  # (nv, nv): 1 where a dof's body moves with a dof
    gravity: Tensor  # (3,), world
    damping: Tensor  # (nv,)
    stiffness: Tensor  # (J,)
    rest: Tensor  # (J,): where a joint's spring is at rest
    armature: Tensor  # (nv,)
    is_slide: Tensor  # (J, 1)

    def __init__(
        self, model: mujoco.MjModel, base: Base, axes: JointAxes, actuated: list[int]
    ) -> None:
        super().__init__()
        where = {dof: at for at, dof in enumerate(actuated)}
        # of each dof its place among the torques, behind them where there is none
        self.torque_at = [where.get(dof, len(actuated)) for dof in range(model.nv)]
        is_still = (model.body_weldid == 0) | (
            model.body_mocapid[model.body_weldid] >= 0
        )
        moves, has_mass = ~is_still, model.body_mass > 0.0
        if model.body_inertia[moves & ~has_mass].any():
            raise ValueError(
                "expected mass where there is inertia, got a moving body without mass"
            )
        has_mass &= moves
        found = np.flatnonzero(has_mass).tolist()
        self.bodies = axes.bodies + [body for body in found for _ in CORNERS]
        corners = (_four_points(model, body) for body in found)
        self.positions = np.concatenate((axes.positions, *corners))
        self.num_base_dofs = 6 * base.is_floating  # dofs that move every body
        self.is_base_damped = base.is_floating and bool(model.dof_damping[:3].any())
        joints, below = axes.joints, axes.bodies[: len(axes.joints)]
        self.qpos_addresses = model.jnt_qposadr[joints].tolist()
        ancestry = np.ones((model.nv, len(found)))
        ancestry[self.num_base_dofs :] = axes.ancestry[:, found]
        together = np.ones((model.nv, model.nv))
        together[self.num_base_dofs :] = 0.0
        together[self.num_base_dofs :, self.num_base_dofs :] = axes.ancestry[:, below]
        keep_constants(
            self,
            mass=model.body_mass[found, None],
            ancestry=ancestry,
            together=together,
            gravity=model.opt.gravity,
            damping=model.dof_damping,
            stiffness=model.jnt_stiffness[joints],
            rest=model.qpos_spring[self.qpos_addresses],
            armature=model.dof_armature,
            is_slide=axes.is_slide[:, None],
        )

    def forward(
        self,
        qpos: Tensor,
        qvel: Tensor,
        joint_torque: Tensor | None,
        rotation: Tensor,
        places: Tensor,
        period: float = 0.0,
    ) -> Tensor:
        """Acceleration ``(*batch, nv)``, in the axes of ``qvel``.

        ``joint_torque (*batch, num_actuated)`` may be None for none. Given are, too, the
        base's ``rotation (*batch, 3, 3)`` and the ``places (*batch, 2 J + 4 B, 3)``, m, of
        the points at ``positions``, in B_t. Damping is implicit over ``period`` s (taken at
        its middle).
        """
        given = qpos, qvel, joint_torque, rotation, places, period
        parts = self.mass_matrix_and_force(*given)
        acceleration = spd_solve(*parts).movedim(0, -1).reshape(qvel.shape)
        if not self.num_base_dofs:
            return acceleration
        linear = (rotation @ acceleration[..., :3, None])[..., 0]
        return torch.cat((linear, acceleration[..., 3:]), -1)

    def mass_matrix_and_force(
        self,
        qpos: Tensor,
        qvel: Tensor,
        joint_torque: Tensor | None,
        rotation: Tensor,
        places: Tensor,
        period: float = 0.0,
    ) -> tuple[Tensor, Tensor]:
        """Mass matrix ``(nv, nv, N)`` and smooth forces ``(nv, N)`` without contacts.

        Arguments as of `forward`. A floating base's linear velocity is in B_t here, in a
        frame that moves with the base.
        """
        rate, position = rows_last(qvel, 1), rows_last(qpos, 1)
        count = 2 * len(self.is_slide)
        axes, corners = places.split((count, places.shape[-2] - count), -2)
        spin, slide = self._axes(rows_last(axes, 2))
        four = rows_last(corners, 2).unflatten(1, (-1, len(CORNERS)))
        second = (four[:, None] * four).sum(3) * (self.mass / len(CORNERS))
        bodies = _Inertia(self.mass, four.mean(2) * self.mass, second)
        moved = _Inertia(*(matvec(self.ancestry, x) for x in bodies))  # by each dof
        moment, force = moved.momentum(spin, slide)
        products = spin[:, :, None] * moment[:, None]  # (3, nv, nv, N)
        products = products + slide[:, :, None] * force[:, None]
        upper = self.together[..., None] * products.sum(0)
        lower = (1.0 - self.together)[..., None] * upper.transpose(0, 1)
        extra = torch.diag(self.armature + 0.5 * period * self.damping)
        mass_matrix = upper + lower + extra[..., None]
        gravity = rows_last((rotation.mT @ self.gravity[:, None])[..., 0], 1)
        smooth = -self._bias(bodies, spin, slide, rate, gravity)
        if self.is_base_damped:
            linear = (rotation.mT @ qvel[..., :3, None])[..., 0]  # in B_t
            rate = torch.cat((rows_last(linear, 1), rate[3:]))
        smooth = smooth - self.damping[:, None] * rate
        if joint_torque is not None:
            torque = rows_last(joint_torque, 1)
            torque = torch.cat((torque, torch.zeros_like(rate[:1])))
            smooth = smooth + take(torque, self.torque_at, 0)
        stretch = self.rest[:, None] - take(position, self.qpos_addresses, 0)
        base, joints = smooth[: self.num_base_dofs], smooth[self.num_base_dofs :]
        joints = joints + self.stiffness[:, None] * stretch
        return mass_matrix, torch.cat((base, joints))

    def _axes(self, places: Tensor) -> tuple[Tensor, Tensor]:
        """How each dof turns, and moves the base frame's origin, ``(3, nv, N)``."""
        anchor, tip = places.chunk(2, 1)
        axis = tip - anchor
        spin = (1.0 - self.is_slide) * axis
        slide = cross(anchor, spin) + self.is_slide * axis
        if self.num_base_dofs:
            one = torch.eye(6, dtype=axis.dtype, device=axis.device)
            one = one[..., None].expand(6, 6, axis.shape[-1])
            slide, spin = torch.cat((one[:3], slide), 1), torch.cat((one[3:], spin), 1)
        return spin, slide

    def _bias(
        self,
        bodies: _Inertia,
        spin: Tensor,
        slide: Tensor,
        rate: Tensor,
        gravity: Tensor,
    ) -> Tensor:
        """Bias forces ``(nv, N)``: Coriolis, centrifugal and gravitational.

        In a frame that moves with the base's origin at its present velocity.
        """
        if self.num_base_dofs:
            rate = torch.cat((torch.zeros_like(rate[:3]), rate[3:]))
        turned, moved = rate * spin, rate * slide
        omega, velocity = (matvec(self.together.mT, x) for x in (turned, moved))
        bend = cross(omega, turned), cross(omega, moved) + cross(velocity, turned)
        omega, velocity = (matvec(self.ancestry.mT, x) for x in (turned, moved))
        alpha, acceleration = (matvec(self.ancestry.mT, x) for x in bend)
        moment, force = bodies.momentum(alpha, acceleration - gravity[:, None])
        angular, linear = bodies.momentum(omega, velocity)
        force = force + cross(omega, linear)
        moment = moment + cross(omega, angular) + cross(velocity, linear)
        moment, force = (matvec(self.ancestry, x) for x in (moment, force))
        return (spin * moment + slide * force).sum(0)


def rows_last(x: Tensor, size: int) -> Tensor:
    """``(*batch, n, d)`` (its last ``size`` dimensions) as ``(d, n, N)``."""
    batch = x.ndim - size
    flat = x.reshape(x.shape[:batch].numel(), *x.shape[batch:])  # empty batches too
    return flat.permute(tuple(reversed(range(flat.ndim))))


def _four_points(model: mujoco.MjModel, body: int) -> np.ndarray:
    """Places ``(4, 3)`` of a quarter of the body's mass each, m, in its frame."""
    inertia = model.body_inertia[body]
    spread = (inertia.sum() / 2.0 - inertia).clip(0.0) / model.body_mass[body]
    turn = quat_matrix(model.body_iquat[body])
    return model.body_ipos[body] + (CORNERS * np.sqrt(spread)) @ turn.T
