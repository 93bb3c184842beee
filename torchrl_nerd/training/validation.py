"""Validation of a model in training: open-loop error against the ground truth."""

from dataclasses import asdict, dataclass
from typing import Any

import torch

from torchrl_nerd.dynamics import MujocoDynamics, NeRDDynamics
from torchrl_nerd.evaluation.rollout_error import ErrorSummary, passive_errors
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.robots import Source

SEED = 1_000_003  # of the initial states, which no test uses: the best model is chosen here
ROLLOUTS = 256

Errors = dict[int, dict[str, ErrorSummary]]
"""Error by horizon in control steps and by quantity."""


@dataclass(frozen=True)
class Validation:
    """Rollouts that measure a model."""

    source: Source  # task or scene whose resets or ranges give the initial states
    horizons: tuple[int, ...]  # control steps averaged over, the shortest first
    random_actions: bool  # uniform actions in [-1, 1] in place of zero

    def __call__(self, model: NeRD, device: torch.device) -> Errors:
        """Errors of a model on the device that it is on."""
        return passive_errors(
            self.source,
            NeRDDynamics(model),
            MujocoDynamics(model.scene),
            list(self.horizons),
            num_trajectories=ROLLOUTS,
            seed=SEED,
            device=device,
            random_actions=self.random_actions,
        )

    def score(self, errors: Errors) -> float:
        """Sum of the mean errors at the longest horizon, by which models are compared."""
        return sum(summary.mean for summary in errors[self.horizons[-1]].values())


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
