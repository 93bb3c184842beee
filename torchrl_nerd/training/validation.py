"""Validation of a model in training: open-loop error against the ground truth."""

from dataclasses import asdict
from typing import Any

from torchrl_nerd.dynamics import MujocoDynamics, NeRDDynamics
from torchrl_nerd.evaluation.rollout_error import ErrorSummary, passive_errors
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.robots import Source

SEED = 1_000_003  # of the initial states, which no test uses: the best model is chosen here
ROLLOUTS = 256

Errors = dict[int, dict[str, ErrorSummary]]
"""Error by horizon in control steps and by quantity."""


def validate(
    model: NeRD,
    source: Source,
    horizons: tuple[int, ...],
    random_actions: bool,
    history: int = 0,
) -> Errors:
    """Errors of a model on the device that it is on; see `passive_errors`."""
    both = NeRDDynamics(model), MujocoDynamics(model.scene)
    about = list(horizons), ROLLOUTS, SEED, model.device, random_actions, history
    return passive_errors(source, *both, *about)


def score(errors: Errors) -> float:
    """Sum of the mean errors at the longest horizon, by which models are compared."""
    return sum(summary.mean for summary in errors[max(errors)].values())


def metrics(errors: Errors) -> dict[str, float]:
    """Mean errors by ``quantity_horizon``, for a log."""
    return {
        f"{name}_{horizon}": summary.mean
        for horizon, by_name in errors.items()
        for name, summary in by_name.items()
    }


def for_card(errors: Errors) -> dict[str, Any]:
    """Errors as JSON: all fields by horizon and quantity."""
    return {
        str(horizon): {name: asdict(summary) for name, summary in by_name.items()}
        for horizon, by_name in errors.items()
    }
