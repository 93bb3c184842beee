"""How a robot that is let go begins to move: gravity, inertia, damping, springs.

Every rigid body is the same as four points of a quarter of its mass each, at the even
corners of a box about its centre: they have its centre and its moments. Where those points
and the joints' axes are tells the mass matrix (composite rigid bodies) and the bias forces
(Newton and Euler's equations), all in the base frame, of all rows at once.
Source: Featherstone, Rigid Body Dynamics Algorithms, chapters 5 and 6.
"""

from typing import NamedTuple

import mujoco
import numpy as np
import torch
from torch import Tensor, nn
from torch.linalg import cross

from torchrl_nerd.geometry.joint_axes import JointAxes
from torchrl_nerd.geometry.kinematics import Base, quat_matrix

CORNERS = np.array([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)], float)


class _Inertia(NamedTuple):
    """Mass ``(n, 1)`` and its first and second moments about the base frame's origin."""

    mass: Tensor
    first: Tensor  # (*batch, n, 3)
    second: Tensor  # (*batch, n, 3, 3)

    def momentum(self, spin: Tensor, slide: Tensor) -> tuple[Tensor, Tensor]:
        """Angular and linear, of bodies that turn and move so, ``(*batch, n, 3)``."""
        trace = self.second.diagonal(dim1=-2, dim2=-1).sum(-1, keepdim=True)
        turning = trace * spin - (self.second @ spin[..., None])[..., 0]
        return (
            turning + cross(self.first, slide),
            self.mass * slide + cross(spin, self.first),
        )

    def of_groups(self, members: Tensor) -> "_Inertia":
        """Of several together, ``members (groups, n)``."""
        second = members @ self.second.flatten(-2)
        return _Inertia(
            members @ self.mass, members @ self.first, second.unflatten(-1, (3, 3))
        )


class FreeMotion(nn.Module):
    """Acceleration of a robot on which neither motors nor ground nor limits act.

    | attribute | meaning |
    |---|---|
    | ``bodies`` | of the points that it needs: four of every body with mass |
    | ``positions`` | ``(4 B, 3)``, m, in the body's frame |

    Args:
        model: compiled.
        base: of the robot.
        axes: its joints.
        period: s over which the acceleration is meant to hold: damping is taken at its
            middle, so that no joint is braked beyond rest.
    """

    mass: Tensor
    carries: Tensor
    together: Tensor
    gravity: Tensor
    damping: Tensor
    stiffness: Tensor
    rest: Tensor
    extra: Tensor
    is_slide: Tensor

    def __init__(
        self, model: mujoco.MjModel, base: Base, axes: JointAxes, period: float
    ) -> None:
        super().__init__()
        has_mass = (model.body_weldid != 0) & (model.body_mass > 0.0)
        found = np.flatnonzero(has_mass).tolist()
        self.bodies = [body for body in found for _ in CORNERS]
        self.positions = np.concatenate([_four_points(model, body) for body in found])
        self.num_whole = 6 * base.is_floating  # dofs that move all there is
        joints, below = axes.joints, axes.bodies[: len(axes.joints)]
        self.qpos_addresses = model.jnt_qposadr[joints].tolist()
        carries = np.ones((model.nv, len(found)))
        carries[self.num_whole :] = axes.carries(found)
        together = np.ones((model.nv, model.nv))
        together[self.num_whole :] = 0.0
        together[self.num_whole :, self.num_whole :] = axes.carries(below)
        braked = 0.5 * period * model.dof_damping
        constants = {
            "mass": model.body_mass[found, None],
            "carries": carries,
            "together": together,
            "gravity": model.opt.gravity,
            "damping": model.dof_damping,
            "stiffness": model.jnt_stiffness[joints],
            "rest": model.qpos_spring[self.qpos_addresses],
            "extra": np.diag(model.dof_armature + braked),
            "is_slide": axes.is_slide[:, None],
        }
        for name, value in constants.items():
            tensor = torch.as_tensor(np.array(value, dtype=np.float64))
            self.register_buffer(name, tensor, persistent=False)

    def forward(
        self,
        qpos: Tensor,
        qvel: Tensor,
        rotation: Tensor,
        corners: Tensor,
        places: Tensor,
    ) -> Tensor:
        """Acceleration ``(*batch, nv)``, in the axes of ``qvel``.

        Args:
            qpos: ``(*batch, nq)``.
            qvel: ``(*batch, nv)``.
            rotation: of the base, ``(*batch, 3, 3)``.
            corners: where ``positions`` are, ``(*batch, 4 B, 3)``, m, in B_t.
            places: of the axes' anchors and tips, ``(*batch, 2 J, 3)``, m, in B_t.
        """
        spin, slide = self._axes(places)
        four = corners.unflatten(-2, (-1, len(CORNERS)))
        second = (self.mass[..., None] / len(CORNERS)) * (four.mT @ four)
        bodies = _Inertia(self.mass, self.mass * four.mean(-2), second)
        moment, force = bodies.of_groups(self.carries).momentum(spin, slide)
        upper = self.together * (spin @ moment.mT + slide @ force.mT)
        mass_matrix = upper + upper.mT * (1.0 - self.together) + self.extra
        bias = self._bias(bodies, spin, slide, qvel, rotation)
        push = -self.damping * qvel - bias
        stretch = self.stiffness * (self.rest - qpos[..., self.qpos_addresses])
        push = push + nn.functional.pad(stretch, (self.num_whole, 0))
        acceleration = torch.linalg.solve(mass_matrix, push)
        if not self.num_whole:
            return acceleration
        linear = (rotation @ acceleration[..., :3, None])[..., 0]
        return torch.cat((linear, acceleration[..., 3:]), -1)

    def _axes(self, places: Tensor) -> tuple[Tensor, Tensor]:
        """How each dof turns, and moves the base frame's origin, ``(*batch, nv, 3)``."""
        anchor, tip = places.chunk(2, -2)
        axis = tip - anchor
        spin = (1.0 - self.is_slide) * axis
        slide = cross(anchor, spin) + self.is_slide * axis
        if self.num_whole:
            one = torch.eye(6, dtype=axis.dtype, device=axis.device)
            one = one.expand(*axis.shape[:-2], 6, 6)
            slide = torch.cat((one[..., :3], slide), -2)
            spin = torch.cat((one[..., 3:], spin), -2)
        return spin, slide

    def _bias(
        self,
        bodies: _Inertia,
        spin: Tensor,
        slide: Tensor,
        qvel: Tensor,
        rotation: Tensor,
    ) -> Tensor:
        """Forces ``(*batch, nv)`` under which nothing would accelerate.

        As seen by one who moves on with the base's origin at its present velocity.
        """
        rate = qvel[..., None]
        if self.num_whole:
            rate = torch.cat((torch.zeros_like(rate[..., :3, :]), rate[..., 3:, :]), -2)
        turned, moved = rate * spin, rate * slide
        omega, velocity = self.together.mT @ turned, self.together.mT @ moved
        bend = cross(omega, turned), cross(omega, moved) + cross(velocity, turned)
        omega, velocity = self.carries.mT @ turned, self.carries.mT @ moved
        alpha, acceleration = (self.carries.mT @ x for x in bend)
        gravity = (rotation.mT @ self.gravity[:, None]).mT
        moment, force = bodies.momentum(alpha, acceleration - gravity)
        angular, linear = bodies.momentum(omega, velocity)
        force = force + cross(omega, linear)
        moment = moment + cross(omega, angular) + cross(velocity, linear)
        along = spin * (self.carries @ moment) + slide * (self.carries @ force)
        return along.sum(-1)


def _four_points(model: mujoco.MjModel, body: int) -> np.ndarray:
    """Places ``(4, 3)`` of a quarter of the body's mass each, m, in its frame."""
    inertia = model.body_inertia[body]
    spread = (inertia.sum() / 2.0 - inertia).clip(0.0) / model.body_mass[body]
    turn = quat_matrix(model.body_iquat[body])
    return model.body_ipos[body] + (CORNERS * np.sqrt(spread)) @ turn.T
