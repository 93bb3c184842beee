"""Curves of fine-tuning: one figure of two errors, and when it was as good as reached."""

from collections.abc import Mapping, Sequence

from torchrl_nerd.training.pose_loss import ORIENTATION_SCALE, POSITION_SCALE

Curve = Sequence[Mapping[str, float]]
"""Points with ``epoch``, ``seconds``, ``position_m`` and ``orientation_rad``."""


def score(point: Mapping[str, float]) -> float:
    """Both errors by the scales of the loss; infinite where one is no number."""
    found = point["position_m"] / POSITION_SCALE
    found += point["orientation_rad"] / ORIENTATION_SCALE
    return found if found == found else float("inf")


def converged(curve: Curve, within: float = 0.05) -> dict[str, float]:
    """Epochs and seconds after which the error was within 5% of the run's lowest."""
    scores = [score(point) for point in curve]
    lowest = min(scores)
    index = next(i for i, x in enumerate(scores) if x <= (1.0 + within) * lowest)
    keys = ("epoch", "seconds", "position_m", "orientation_rad")
    found = {f"converged_{key}": curve[index][key] for key in keys[:2]}
    best = curve[scores.index(lowest)]
    return {**found, **{f"validation_{key}": best[key] for key in keys[2:]}}
