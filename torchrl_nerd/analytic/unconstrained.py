"""Unconstrained (contact-free) forward dynamics over one control step.

The mean of MuJoCo's accelerations at the starts of its n semi-implicit Euler substeps is,
to second order, that at the mean of those times, ``(h - h/n) / 2``. The step evaluates the
dynamics at the start, to predict the state at that time, and there. This midpoint rule
shares the substeps' error. Joint limits change faster: several solves per step.
"""

import mujoco
from torch import Tensor

from torchrl_nerd.analytic.base import AnalyticStep, StepResult, check_supported
from torchrl_nerd.analytic.joint_limits import JointLimits
from torchrl_nerd.configs import UnconstrainedConfig
from torchrl_nerd.geometry.base import BasePose, JointAxes
from torchrl_nerd.geometry.kinematics import PointKinematics
from torchrl_nerd.geometry.manifold import integrate_pos
from torchrl_nerd.geometry.rigid_body import RigidBodyDynamics
from torchrl_nerd.geometry.spd import spd_inverse
from torchrl_nerd.scenes.scene import Scene


class UnconstrainedStep(AnalyticStep):
    """One control step of a robot that touches nothing; see `AnalyticStep`.

    Limits act on the joints of a robot with a fixed base, see `JointLimits`.
    ``velocity_defect (*batch, nv)`` is by how much the second dynamics evaluation changed
    the step's velocity.

    Args:
        scene: a robot of hinges and slides, on a fixed base, or on a floating one without
            joint limits, without dry friction. A ground is allowed and ignored.

    Raises:
        ValueError: in one sentence, another robot.
    """

    def __init__(self, scene: Scene) -> None:
        check_supported(scene)
        super().__init__(scene, UnconstrainedConfig(), scene.layout.nv)
        model, self.step_size = scene.model, scene.control_step
        # s: substep whose first-order error the step shares
        has_lag = model.opt.integrator != mujoco.mjtIntegrator.mjINT_RK4
        self.lag = has_lag * float(model.opt.timestep)
        axes = JointAxes.of(model, scene.base)
        self.rigid_body = RigidBodyDynamics(model, scene.base, axes, scene.actuated)
        points = self.rigid_body.bodies, self.rigid_body.positions
        self.kinematics = PointKinematics(model, scene.base, *points)
        self.pose = BasePose(model, scene.base)
        self.layout = scene.layout
        self.limits, self.num_solves = None, 1
        if model.jnt_limited[axes.joints].any():
            if scene.base.is_floating:
                raise ValueError(
                    "expected, for an unconstrained step, a fixed base or joints without "
                    f"limits, got a floating base with them in scene '{scene.name}'"
                )
            self.limits = JointLimits(model, axes)
            self.num_solves = self.limits.num_solves(self.step_size)

    def _step(
        self, qpos: Tensor, qvel: Tensor, torque: Tensor | None, ground: Tensor | None
    ) -> StepResult:
        """See `AnalyticStep`."""
        ahead = 0.5 * (self.step_size - self.lag)
        state, solves = (qpos, qvel), self.num_solves
        start = self._dynamics(*state, torque, 2.0 * ahead)
        middle = self._integrate(*state, start, ahead, solves // 2)
        dynamics = self._dynamics(*middle, torque, 2.0 * self.lag)
        after = self._integrate(*state, dynamics, self.step_size, solves)
        return StepResult(*after, self.step_size * (dynamics[0] - start[0]))

    def _dynamics(
        self, qpos: Tensor, qvel: Tensor, joint_torque: Tensor | None, period: float
    ) -> tuple[Tensor, Tensor | None]:
        """Unconstrained acceleration ``(N, nv)``, inverse mass matrix ``(nv, nv, N)``.

        The inverse is None where no limit needs it.
        """
        places, _ = self.kinematics(qpos, qvel)
        given = qpos, qvel, joint_torque, self.pose(qpos)[1], places, period
        if self.limits is None:
            return self.rigid_body(*given), None
        inverse, qacc = spd_inverse(*self.rigid_body.mass_matrix_and_force(*given))
        return qacc.mT, inverse

    def _integrate(
        self,
        qpos: Tensor,
        qvel: Tensor,
        dynamics: tuple[Tensor, Tensor | None],
        period: float,
        num_solves: int,
    ) -> tuple[Tensor, Tensor]:
        """The state after ``period`` s under one evaluation of the dynamics."""
        qacc, inverse = dynamics
        if self.limits is None or inverse is None:
            moved = period * (qvel + 0.5 * (period + self.lag) * qacc)
            return integrate_pos(self.layout, qpos, moved), qvel + period * qacc
        held = inverse, period, num_solves, self.lag
        next_qpos, next_qvel = self.limits(qpos.mT, qvel.mT, qacc.mT, *held)
        return next_qpos.mT, next_qvel.mT
