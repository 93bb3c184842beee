"""The dynamics of any model: learned, hybrid or analytic."""

from typing import Any

from torchrl_nerd.analytic import AnalyticStep
from torchrl_nerd.dynamics.analytic import AnalyticDynamics
from torchrl_nerd.dynamics.nerd import NeRDDynamics
from torchrl_nerd.modules.nerd import NeRD

Model = NeRD | AnalyticStep
"""Learned, hybrid (a `NeRD`) or analytic; ``kind`` says which."""


def dynamics_of(
    model: Model, compile: bool = False, differentiable: bool = False, **how: Any
) -> NeRDDynamics | AnalyticDynamics:
    """The dynamics of a model.

    Args:
        model: learned, hybrid or analytic.
        compile: see `NeRDDynamics`.
        differentiable: see `NeRDDynamics`.
        how: further arguments of `NeRDDynamics`; an analytic step has no history and
            ignores them.
    """
    if isinstance(model, NeRD):
        return NeRDDynamics(
            model, compile=compile, differentiable=differentiable, **how
        )
    return AnalyticDynamics(model, compile, differentiable)
