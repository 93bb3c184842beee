"""Dynamics without weights: an analytic step."""

from typing import Any

from torch import Tensor

from torchrl_nerd.analytic import AnalyticStep
from torchrl_nerd.dynamics.torch_step import TorchDynamics


class AnalyticDynamics(TorchDynamics):
    """An `AnalyticStep` as dynamics; it has no history.

    Args:
        step: of the robot.
        compile: run through `torch.compile`; without a compiler, eager with a warning.
        differentiable: record gradients through the step.
    """

    kind = "analytic"

    def __init__(
        self, step: AnalyticStep, compile: bool = False, differentiable: bool = False
    ) -> None:
        self.analytic_step = step
        is_single = step.compile_single_threaded
        super().__init__(step.scene, step.device, compile, differentiable, is_single)

    def _predict(
        self,
        qpos: Tensor,
        qvel: Tensor,
        joint_torque: Tensor,
        terrain: Tensor | None,
        memory: Any,
        is_scored: bool,
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        result = self.analytic_step(qpos, qvel, joint_torque, terrain)
        return result.qpos, result.qvel, None
