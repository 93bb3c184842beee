"""Analytic steps: the equation of motion, penalty contacts and limits; no weights."""

from dataclasses import asdict

import torch

from torchrl_nerd.analytic.base import AnalyticStep, StepResult
from torchrl_nerd.analytic.free_body import FreeBodyPenaltyStep
from torchrl_nerd.analytic.penalty_contact import PenaltyContactStep
from torchrl_nerd.analytic.unconstrained import UnconstrainedStep
from torchrl_nerd.configs import (
    FreeBodyConfig,
    PenaltyContactConfig,
    StepConfig,
    UnconstrainedConfig,
)
from torchrl_nerd.scenes.scene import Scene

__all__ = [
    "STEPS",
    "AnalyticStep",
    "FreeBodyPenaltyStep",
    "PenaltyContactStep",
    "StepResult",
    "UnconstrainedStep",
    "default_step",
    "fitting_steps",
    "make_step",
]

STEPS: dict[str, StepConfig] = {
    "unconstrained": UnconstrainedConfig(),
    "penalty-contact": PenaltyContactConfig(num_outer_steps=1),
    "penalty-contact-2-outer-steps": PenaltyContactConfig(),
    "penalty-contact-1-stage": PenaltyContactConfig(1, 1),
    "penalty-contact-1-stage-merged": PenaltyContactConfig(1, 1, merged_substeps=2),
}


def default_step(scene: Scene) -> StepConfig:
    """The step of ``dynamics="analytic"``, the most exact one.

    Unconstrained without a ground; else two stages, in two outer steps where the scene's
    substeps can be halved.
    """
    if scene.terrain is None:
        return UnconstrainedConfig()
    return PenaltyContactConfig(num_outer_steps=2 - scene.substeps % 2)


@torch.inference_mode(False)
def make_step(scene: Scene, config: StepConfig | None = None) -> AnalyticStep:
    """The step of that configuration for a scene, or its default step.

    Raises:
        ValueError: in one sentence, a scene that it cannot step.
    """
    config = default_step(scene) if config is None else config
    if isinstance(config, UnconstrainedConfig):
        return UnconstrainedStep(scene)
    if isinstance(config, FreeBodyConfig):
        return FreeBodyPenaltyStep(scene, **asdict(config))
    return PenaltyContactStep(scene, **asdict(config))


def fitting_steps(scene: Scene) -> tuple[list[str], str]:
    """Names in `STEPS` that can step a scene, and why another one cannot."""
    names, reason = [], ""
    for name, config in STEPS.items():
        try:
            make_step(scene, config)
            names.append(name)
        except ValueError as error:
            reason = str(error)
    return names, reason
