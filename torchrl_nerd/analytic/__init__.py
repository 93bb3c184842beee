"""Analytic steps: the equation of motion, penalty contacts and limits; no weights."""

from torchrl_nerd.analytic.base import AnalyticStep, StepResult
from torchrl_nerd.analytic.free_body import FreeBodyPenaltyStep
from torchrl_nerd.analytic.penalty_contact import PenaltyContactStep
from torchrl_nerd.analytic.steps import STEPS, default_step, make_step, step_config
from torchrl_nerd.analytic.unconstrained import UnconstrainedStep

__all__ = [
    "STEPS",
    "AnalyticStep",
    "FreeBodyPenaltyStep",
    "PenaltyContactStep",
    "StepResult",
    "UnconstrainedStep",
    "default_step",
    "make_step",
    "step_config",
]
