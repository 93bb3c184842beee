"""Error over recorded trajectories: rollouts from recorded states, never corrected.

NeRD appendix C.4, for tosses of a cube: every 80 consecutive states of the test tosses;
from the first of them the model rolls out the other 79; mean error along the path. Windows
of one trajectory overlap, so intervals are found by drawing trajectories again.
"""

import math
from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDict
from torch import Generator, Tensor

from torchrl_nerd.data.recorded import Recording
from torchrl_nerd.dynamics import Dynamics
from torchrl_nerd.evaluation.bench.candidates import NoMotion
from torchrl_nerd.evaluation.position_error import Errors, position_errors, unit_of
from torchrl_nerd.evaluation.rollout_error import open_loop
from torchrl_nerd.evaluation.tables import text_table
from torchrl_nerd.keys import QPOS
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.commands import command_of

STATES = 80  # of a window, the start among them
DRAWS = 2000  # of the trajectories, for intervals
PART = 2048  # windows rolled out at a time
BASE = {"base_position": "m", "base_orientation": "rad"}


def window_errors(
    dynamics: Dynamics, recording: Recording, starts: Tensor, states: int = STATES
) -> Errors:
    """Errors after each step of rollouts over so many ``states`` of a recording.

    ``starts``: frames of the first states, ``(windows,)``.
    """
    parts = (recording.windows(part, states) for part in starts.split(PART))
    found = [errors_along(dynamics, window) for window in parts]
    return {name: torch.cat([part[name] for part in found]) for name in found[0]}


def errors_along(dynamics: Dynamics, window: TensorDict) -> Errors:
    """Errors of a rollout from the first of consecutive states ``[windows, states]``."""
    command = command_of(dynamics.scene, window)
    path = open_loop(dynamics, window[:, 0], window.shape[1] - 1, command)
    return position_errors(dynamics.scene, window[QPOS][:, 1:], path)


def error_key(scene: Scene, quantity: str, joint: str = "_error_") -> str:
    """A quantity and its unit as one word: ``position_error_m``, ``elbow_error_rad``."""
    return quantity.removeprefix("base_") + joint + unit_of(scene, quantity)


def resampled_means(values: Tensor, group: Tensor, draws: int = DRAWS) -> Tensor:
    """Means over windows of trajectories drawn with replacement, ``(draws,)``.

    ``values`` of windows, and the numbers of their trajectories, ``group``: ``(windows,)``.
    """
    found, number = group.unique(return_inverse=True)
    sums = torch.zeros(len(found)).to(values).index_add(0, number, values)
    counts = torch.bincount(number, minlength=len(found)).to(values)
    generator = Generator().manual_seed(0)
    pick = torch.randint(len(found), (draws, len(found)), generator=generator)
    # sums of the drawn trajectories over their numbers of windows: (draws,)
    return sums[pick].sum(1) / counts[pick].sum(1)


def paired_interval(a: Tensor, b: Tensor, group: Tensor) -> tuple[float, float]:
    """95% interval over trajectories of mean(a) - mean(b), errors ``(windows, steps)``.

    ``group``: number of each window's trajectory, ``(windows,)``. NaN where there is one:
    it tells nothing of others.
    """
    if len(group.unique()) < 2:
        return math.nan, math.nan
    means = resampled_means((a - b).mean(1), group)  # (draws,)
    low, high = means.quantile(means.new_tensor((0.025, 0.975))).tolist()
    return low, high


def summarize_windows(
    scene: Scene, errors: Errors, recording: Recording, starts: Tensor
) -> dict[str, dict[str, Any]]:
    """Summary of each quantity, m or rad; ``starts`` as of `window_errors`.

    Returns:
        By `error_key`: ``mean`` along the path and over windows; ``final``, the mean at the
        last state; ``median`` and 95th percentile ``p95`` over windows of their mean;
        ``interval``, half width of the mean's 95% interval over trajectories; ``first``,
        the mean over windows that start their trajectory, NaN if none.
    """
    group = recording.trajectory_of(starts)
    is_first = starts == recording.offsets[group]
    found = {}
    for quantity, error in errors.items():
        mean = error.mean(1)  # (windows,)
        low, high = paired_interval(error, torch.zeros_like(error), group)
        found[error_key(scene, quantity)] = {
            "mean": float(mean.mean()),
            "final": float(error[:, -1].mean()),
            "median": float(mean.median()),
            "p95": float(mean.quantile(0.95)),
            "interval": 0.5 * (high - low),
            "first": float(mean[is_first].mean()),
        }
    return found


def compare(
    models: Mapping[str, Dynamics],
    scene: Scene,
    recording: Recording,
    starts: Tensor,
    states: int = STATES,
) -> dict[str, dict[str, Any]]:
    """Errors of no motion and of every model; ``starts`` and ``states`` of `window_errors`.

    ``against`` holds, for every other model, 95% intervals over trajectories of the errors
    less the other's: below 0 the model is ahead. Its keys are ``m`` and ``rad`` for the
    base, names for joints.
    """
    errors = {
        name: window_errors(dynamics, recording, starts, states)
        for name, dynamics in {"no motion": NoMotion(scene), **models}.items()
    }
    group, table = recording.trajectory_of(starts), {}
    for name, mine in errors.items():
        table[name] = summarize_windows(scene, mine, recording, starts)
        if len(models) > 1:
            table[name]["against"] = {
                other: {
                    BASE.get(key, key): paired_interval(mine[key], its[key], group)
                    for key in mine
                }
                for other, its in errors.items()
                if other not in (name, "no motion")
            }
    return table


def errors_as_text(
    table: Mapping[str, Mapping[str, Any]],
    published: Mapping[str, Mapping[str, float]],
    states: int = STATES,
) -> str:
    """The rows of `compare` as text, published mean errors last."""
    columns = ("mean", "interval", "median", "final", "p95", "first")
    papers = {
        name: {key: {"mean": mean} for key, mean in means.items()}
        for name, means in published.items()
    }
    body = []
    for name, row in (*table.items(), *papers.items()):
        for key, error in row.items():
            if key != "against":
                cells = (f"{error[c]:.3g}" if c in error else "" for c in columns)
                body.append([name, key.replace("_error_", " "), *cells])
    return text_table([f"{states} states", "quantity", *columns], body)
