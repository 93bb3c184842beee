"""Error over recorded tosses: rollouts from recorded states, never corrected.

NeRD appendix C.4: every 80 consecutive states of the test tosses; from the first of them
the model rolls out the other 79; mean distance of the centre and mean geodesic angle along
the path. Windows of one toss overlap, so that intervals are found by drawing tosses again.
"""

from dataclasses import dataclass

import torch
from tensordict import TensorDict
from torch import Generator, Tensor

from torchrl_nerd.data.cube_tosses import Tosses
from torchrl_nerd.dynamics.base import Dynamics
from torchrl_nerd.evaluation.rollout_error import open_loop
from torchrl_nerd.geometry.rotations import orientation_error
from torchrl_nerd.keys import QPOS

STATES = 80  # of a sub-trajectory, the start among them; the shortest toss has as many
DRAWS = 2000  # of the tosses, for intervals
PART = 2048  # sub-trajectories rolled out at a time
PUBLISHED = {
    "paper: simulator, tuned by hand": (0.036, 0.383),
    "paper: NeRD from scratch": (0.023, 0.276),
    "paper: NeRD fine-tuned": (0.018, 0.266),
    "paper: ContactNets": (0.017, 0.242),
}
"""Mean errors (m, rad) on other tosses of the same set: a comparison is indicative."""


@dataclass(frozen=True)
class TossError:
    """One error over all sub-trajectories, m or rad.

    | field | meaning |
    |---|---|
    | ``mean`` | along the path, over sub-trajectories |
    | ``final`` | mean at the last state |
    | ``median`` | over sub-trajectories of their mean along the path |
    | ``p95`` | 95th percentile of the same |
    | ``interval`` | half width of the 95% interval of the mean, over tosses |
    | ``first`` | mean along the paths that start at a toss's first state |
    """

    mean: float
    final: float
    median: float
    p95: float
    interval: float
    first: float


def toss_errors(
    dynamics: Dynamics, tosses: Tosses, starts: Tensor, states: int = STATES
) -> tuple[Tensor, Tensor]:
    """Distance (m) and angle (rad) after each step, ``(windows, states - 1)`` each.

    Args:
        dynamics: learned or true.
        tosses: recorded.
        starts: rows of the first states.
        states: of a sub-trajectory.
    """
    distance, angle = [], []
    for part in starts.split(PART):
        window = tosses.windows(part, states)
        path = open_loop(dynamics, first_state(window), states - 1)
        measured = window[QPOS][:, 1:]
        found = path_errors(path, measured)
        distance.append(found[0])
        angle.append(found[1])
    return torch.cat(distance), torch.cat(angle)


def first_state(window: TensorDict) -> TensorDict:
    """Starts ``[windows]`` of ``[windows, states]``."""
    values = {key: window[key][:, 0].clone() for key in window.keys()}
    return TensorDict(values, [window.batch_size[0]])


def no_motion(tosses: Tosses, starts: Tensor, states: int = STATES) -> tuple:
    """Errors of a cube that stays where it is, m and rad, as `toss_errors` gives them.

    ``starts (rows,)``: where sub-trajectories of ``states`` begin.
    """
    measured = tosses.windows(starts, states)[QPOS]
    return path_errors(measured[:, :1].expand_as(measured[:, 1:]), measured[:, 1:])


def path_errors(path: Tensor, measured: Tensor) -> tuple[Tensor, Tensor]:
    """Distance (m) and geodesic angle (rad) between poses ``(*batch, 7)``."""
    distance = torch.linalg.vector_norm(path[..., :3] - measured[..., :3], dim=-1)
    return distance, orientation_error(measured[..., 3:7], path[..., 3:7])


def summarize_tosses(error: Tensor, toss: Tensor, is_first: Tensor) -> TossError:
    """Figures of one error.

    Args:
        error: ``(windows, steps)``.
        toss: the toss of each window, ``(windows,)``.
        is_first: windows that start with their toss.
    """
    mean = error.mean(1)
    return TossError(
        mean=float(mean.mean()),
        final=float(error[:, -1].mean()),
        median=float(mean.median()),
        p95=float(mean.quantile(0.95)),
        interval=float(_half_width(resampled_means(mean, toss))),
        first=float(mean[is_first].mean()),
    )


def resampled_means(values: Tensor, toss: Tensor, draws: int = DRAWS) -> Tensor:
    """Means over windows of tosses drawn with replacement, ``(draws,)``."""
    found, number = toss.unique(return_inverse=True)
    sums = torch.zeros(len(found)).to(values).index_add(0, number, values)
    counts = torch.bincount(number, minlength=len(found)).to(values)
    generator = Generator().manual_seed(0)
    pick = torch.randint(len(found), (draws, len(found)), generator=generator)
    return sums[pick].sum(1) / counts[pick].sum(1)


def paired_interval(a: Tensor, b: Tensor, toss: Tensor) -> tuple[float, float]:
    """95% interval of mean(a) - mean(b), over tosses, for errors of the same windows."""
    means = resampled_means((a - b).mean(1), toss)
    low, high = means.quantile(means.new_tensor((0.025, 0.975))).tolist()
    return low, high


def _half_width(means: Tensor) -> Tensor:
    low, high = means.quantile(means.new_tensor((0.025, 0.975)))
    return 0.5 * (high - low)


def summarize_both(
    errors: tuple[Tensor, Tensor], tosses: Tosses, starts: Tensor
) -> dict[str, TossError]:
    """``position_error_m`` and ``orientation_error_rad`` of what `toss_errors` gives.

    ``starts (rows,)``: where the sub-trajectories begin.
    """
    toss = tosses.toss_of(starts)
    is_first = starts == tosses.offsets[toss]
    names = ("position_error_m", "orientation_error_rad")
    return {
        name: summarize_tosses(error, toss, is_first)
        for name, error in zip(names, errors, strict=True)
    }
