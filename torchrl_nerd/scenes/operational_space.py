"""Operational-space control of an arm: from where its hand should go to joint torques.

Source: Khatib, A unified approach for motion and force control of robot manipulators: the
operational space formulation, 1987, https://doi.org/10.1109/JRA.1987.1087068.
"""

import mujoco
import numpy as np
import torch
from torch import Tensor

from torchrl_nerd.geometry.base import Base, BasePose, JointAxes
from torchrl_nerd.geometry.constants import constant, take
from torchrl_nerd.geometry.kinematics import PointKinematics
from torchrl_nerd.geometry.rigid_body import RigidBodyDynamics, other_forces
from torchrl_nerd.geometry.serial_chain import SiteKinematics, bias_acceleration
from torchrl_nerd.scenes.controllers import Row, driven_dofs
from torchrl_nerd.settings import expect_at_least

AXES = 3, 6  # position alone, or position and orientation


class OperationalSpaceController:
    """Move a site of an arm; the joints that this leaves free go to a home pose.

    The first three actions are a displacement of the site in world axes. Three more, where
    there are any, turn it about these axes. With the site's pose x, its Jacobian J, the
    mass matrix M, Coriolis, gravity and passive forces h:

        a = kp (target - x) - kd x'
        u = home_kp (home - q) - home_kd q'
        Lambda = (J M^-1 J^T + I / max_mass)^-1
        q'' = u + M^-1 J^T Lambda (a - J' q' - J u)
        torque = clip(M q'' + h, -limit, limit)

    Unclipped, the site accelerates by a, and u acts in the null space of J. ``max_mass``
    bounds the mass that the site may seem to have: near a singularity the law asks for less
    than a, in place of unbounded torques. The torque is that of the start of a control
    step, over which it is held.

    Args:
        model: an arm of hinges and slides, one to a body, on a fixed base.
        site: name of the site.
        kp: stiffness per axis, 1/s^2; three numbers, or six to control orientation too.
        kd: damping per axis, 1/s.
        scale: m (rad) per unit of action.
        home: joint positions ``(nq,)``.
        limit: largest torque of each actuated dof, N m or N; None for none.
        home_kp: stiffness toward home, 1/s^2.
        home_kd: damping of the joints in the null space, 1/s.
        max_mass: kg (kg m^2 for rotations).

    Raises:
        ValueError: in one sentence, another robot, no such site, a joint on the way to it
            that nothing drives, numbers of another length or sign.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        site: str,
        kp: Row,
        kd: Row,
        scale: Row,
        home: Row,
        limit: Row | None = None,
        home_kp: float = 10.0,
        home_kd: float = 6.0,
        max_mass: float = 200.0,
    ) -> None:
        self.kp, self.kd, self.scale, self.home = map(_row, (kp, kd, scale, home))
        self.limit = None if limit is None else _row(limit)
        self.home_kp, self.home_kd, self.max_mass = home_kp, home_kd, max_mass
        self.actuated, base = driven_dofs(model), Base.from_model(model)
        self._check(model)
        if base.is_floating:
            raise ValueError("expected an arm on a fixed base, got a floating one")
        axes = JointAxes.of(model, base)
        self.site = SiteKinematics(model, site)
        undriven = [v for v in self.site.dof_addresses if v not in self.actuated]
        if undriven:
            name = model.joint(int(model.dof_jntid[undriven[0]])).name
            raise ValueError(
                f"expected actuators on all joints on the way to site '{site}', got "
                f"none on '{name}'"
            )
        self.rigid_body = RigidBodyDynamics(model, base, axes, self.actuated)
        points = self.rigid_body.bodies, self.rigid_body.positions
        self.kinematics = PointKinematics(model, base, *points)
        self.base_pose = BasePose(model, base)

    def _check(self, model: mujoco.MjModel) -> None:
        if found := [
            name for name, is_there in other_forces(model).items() if is_there
        ]:
            raise ValueError(
                f"expected an arm whose forces the controller knows, got one with "
                f"{', '.join(found)}"
            )
        if len(self.scale) not in AXES:
            raise ValueError(f"expected 3 or 6 numbers as scale, got {len(self.scale)}")
        lengths = {"kp": self.num_actions, "kd": self.num_actions}
        lengths |= {"home": model.nq, "limit": len(self.actuated)}
        for name, length in lengths.items():
            value = getattr(self, name)
            if value is not None and len(value) != length:
                raise ValueError(
                    f"expected {length} numbers as {name}, got {len(value)}"
                )
        for name in ("kp", "kd", "limit", "home_kp", "home_kd"):
            value = getattr(self, name)
            if value is not None:
                expect_at_least(0.0, **{name: float(np.min(value))})  # NaN is not
        gains = (*self.kp, *self.kd, self.home_kp, self.home_kd)
        places = (*self.scale, *self.home)
        if not np.isfinite((*gains, *places)).all():
            raise ValueError(
                "expected finite numbers as kp, kd, home_kp, home_kd, scale and home, "
                f"got {gains} and {places}"
            )
        if not self.max_mass > 0.0:
            raise ValueError(f"expected max_mass above 0, got {self.max_mass}")

    @property
    def num_actions(self) -> int:
        """Three, or six with orientation."""
        return len(self.scale)

    def __call__(self, action: Tensor, qpos: Tensor, qvel: Tensor) -> Tensor:
        """Joint torques ``(*batch, num_actuated)``, N m and N, in the dtype of qpos."""
        offset = action.to(qpos.dtype).clamp(-1.0, 1.0) * constant(qpos, self.scale)
        return self.torque(constant(qpos, self.kp) * offset, qpos, qvel)

    def torque(self, acceleration: Tensor, qpos: Tensor, qvel: Tensor) -> Tensor:
        """Torques that accelerate the site, less its damping kd x', within the limits.

        From an ``acceleration (*batch, num_actions)``, m/s^2 and rad/s^2, in the world:
        ``(*batch, num_actuated)``, N m and N.
        """
        count = self.num_actions
        a, q, v = acceleration.double(), qpos.double(), qvel.double()
        mass_matrix, bias = self._equation_of_motion(q, v)
        found, dofs = self.site(q).jacobian, self.site.dof_addresses
        drift = bias_acceleration(found, take(v, dofs))[..., :count]  # J' q'
        found = found[..., :count, :]
        found = torch.cat((found, torch.zeros_like(found[..., :1])), -1)
        where = {dof: at for at, dof in enumerate(dofs)}
        at = [where.get(dof, len(dofs)) for dof in range(v.shape[-1])]
        jacobian = take(found, at)
        free = self.home_kp * (constant(q, self.home) - q) - self.home_kd * v
        wanted = a - constant(q, self.kd) * _times(jacobian, v)
        wanted = wanted - drift - _times(jacobian, free)
        solve = torch.linalg.solve_ex  # what is not finite stays so, without an error
        pulled = solve(mass_matrix, jacobian.mT)[0]  # M^-1 J^T
        one = torch.eye(count, dtype=q.dtype, device=q.device)
        force = solve(jacobian @ pulled + one / self.max_mass, wanted[..., None])[0]
        qacc = free + (pulled @ force)[..., 0]
        torque = take(_times(mass_matrix, qacc) + bias, self.actuated)
        if self.limit is not None:
            limit = constant(q, self.limit)
            torque = torch.minimum(torch.maximum(torque, -limit), limit)
        return torque.to(qpos.dtype)

    def _equation_of_motion(self, qpos: Tensor, qvel: Tensor) -> tuple[Tensor, Tensor]:
        """Mass matrix ``(*batch, nv, nv)`` and forces to overcome ``(*batch, nv)``."""
        for module in (self.kinematics, self.base_pose, self.rigid_body):
            module.to(qpos.device)
        still = qvel.new_zeros(0, qvel.shape[-1])  # no velocities: positions alone
        places, _ = self.kinematics(qpos, still)
        given = qpos, qvel, None, self.base_pose(qpos)[1], places
        matrix, force = self.rigid_body.mass_matrix_and_force(*given)
        shape = *qpos.shape[:-1], *force.shape[:1]
        matrix = matrix.movedim(-1, 0).reshape(*shape, len(force))
        return matrix, -force.movedim(-1, 0).reshape(shape)


def _row(numbers: Row) -> Row:
    """Numbers as a tuple of floats; they may come as an array."""
    return tuple(float(x) for x in numbers)


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    return (matrix @ vector[..., None])[..., 0]
