"""A control step with penalty contacts: few dynamics evaluations, many force substeps.

Within a control step the mass matrix, bias forces, kinematics and collision change little
and smoothly. The stiff forces of contacts and limits do not, but their law is a cheap
function of depth and velocity. So the dynamics are evaluated at ``num_stages`` times only,
and MuJoCo's substeps are made with the force law anew and all else interpolated.

| stages | evaluated at |
|---|---|
| 1 | the mean time of the substeps, extrapolated at the start's velocity |
| 2 | the start, and the mean time, which the substeps so far lead to |
"""

import torch
from torch import Tensor

from torchrl_nerd.analytic.base import AnalyticStep, StepResult, check_supported
from torchrl_nerd.analytic.frozen_dynamics import DynamicsEvaluation
from torchrl_nerd.analytic.substeps import SubstepIntegrator, SubstepState, state_at
from torchrl_nerd.configs import PenaltyContactConfig, Precision
from torchrl_nerd.geometry.base import JointAxes
from torchrl_nerd.geometry.manifold import integrate_pos
from torchrl_nerd.scenes.scene import Scene
from torchrl_nerd.settings import expect_count


class PenaltyContactStep(AnalyticStep):
    """One control step of a robot with penalty contacts and limits; see `AnalyticStep`.

    ``velocity_defect (*batch, num_outer_steps * nv)`` is, per outer step, the velocity that
    the substeps have at the time of the last dynamics evaluation less the one that it was
    made with, a floating base's in its own axes there.

    Args:
        scene: a robot of hinges and slides, on a floating or a fixed base, over a ground,
            whose contacts and limits follow the penalty law, see `scenes.penalty_law`.
        num_stages: dynamics evaluations per outer step: 1 or 2.
        num_outer_steps: equal parts of the control step, one after the other.
        merged_substeps: how many of MuJoCo's substeps are made as one.
        precision: of the forces and substeps; poses are float64.

    Raises:
        ValueError: in one sentence, another robot, number of stages, or substeps that the
            outer steps do not divide.
    """

    def __init__(
        self,
        scene: Scene,
        num_stages: int = 2,
        num_outer_steps: int = 2,
        merged_substeps: int = 1,
        precision: Precision = "float32",
    ) -> None:
        expect_count(
            1, num_outer_steps=num_outer_steps, merged_substeps=merged_substeps
        )
        if num_stages not in (1, 2):
            raise ValueError(f"expected 1 or 2 stages, got {num_stages}")
        check_supported(scene)
        config = PenaltyContactConfig(
            num_stages, num_outer_steps, merged_substeps, precision
        )
        super().__init__(scene, config, num_outer_steps * scene.layout.nv)
        if scene.integrator != "Euler":
            raise ValueError(
                f"expected substeps of Euler, got {scene.integrator} in scene "
                f"'{scene.name}'"
            )
        substeps = max(1, scene.substeps // merged_substeps)
        if substeps % num_outer_steps:
            raise ValueError(
                f"expected outer steps that divide {substeps} substeps, got "
                f"{num_outer_steps}"
            )
        self.num_stages, self.num_outer_steps = num_stages, num_outer_steps
        self.num_substeps = substeps // num_outer_steps  # of each outer step
        self.step_size = scene.control_step / substeps
        self.mean_time = 0.5 * (self.num_substeps - 1)  # in substeps
        axes = JointAxes.of(scene.model, scene.base)
        self.evaluation = DynamicsEvaluation(scene, axes, 2.0 * self.step_size)
        self.layout, self.dtype = scene.layout, getattr(torch, precision)
        parts = axes, self.evaluation, self.step_size
        self.integrator = SubstepIntegrator(scene, *parts)

    def _step(
        self, qpos: Tensor, qvel: Tensor, torque: Tensor | None, ground: Tensor | None
    ) -> StepResult:
        """See `AnalyticStep`."""
        defects = []
        for _ in range(self.num_outer_steps):
            qpos, qvel, defect = self._outer_step(qpos, qvel, torque, ground)
            defects.append(defect)
        return StepResult(qpos, qvel, torch.cat(defects, -1))

    def _outer_step(
        self, qpos: Tensor, qvel: Tensor, torque: Tensor | None, ground: Tensor | None
    ) -> StepResult:
        """One outer step of ``N`` robots, ``qpos (N, nq)``."""
        drive = torque, ground, self.dtype
        integrator, mean, velocity = self.integrator, self.mean_time, qvel
        if self.num_stages == 1:
            ahead = mean * self.step_size
            position = integrate_pos(self.layout, qpos, ahead * qvel)
            dynamics, between = self.evaluation(position, qvel, *drive), 0.0
            # depths at the start, from which the substeps go on
            speed = integrator.to_base_frame(qvel.mT, dynamics.rotation.mT)
            speed = speed.to(self.dtype)
            moving = self.evaluation.point_velocity(dynamics.jacobian, speed)
            rising = (moving * dynamics.normal).sum(0)
            dynamics = dynamics._replace(depth=dynamics.depth + ahead * rising)
            start = dynamics
        else:
            start = self.evaluation(qpos, qvel, *drive)
            states = integrator.integrate_substeps(start, start, 0.0, qpos, qvel, mean)
            state = state_at(states, mean)
            position, velocity = self._moved(qpos, state, start.rotation)
            dynamics, between = self.evaluation(position, velocity, *drive), mean
        states = integrator.integrate_substeps(
            start, dynamics, between, qpos, qvel, self.num_substeps
        )
        used = integrator.to_base_frame(velocity.mT, dynamics.rotation.mT)
        defect = (state_at(states, mean).qvel - used).mT
        return StepResult(*self._moved(qpos, states[-1], dynamics.rotation), defect)

    def _moved(
        self, qpos: Tensor, state: SubstepState, rotation: Tensor
    ) -> tuple[Tensor, Tensor]:
        """``qpos (N, nq)`` and ``qvel (N, nv)`` at a state of the substeps."""
        qvel, moved = (
            self.integrator.to_base_frame(x.to(qpos), rotation).mT for x in state
        )
        return integrate_pos(self.layout, qpos, moved), qvel
