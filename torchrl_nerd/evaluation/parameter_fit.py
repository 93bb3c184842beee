"""Physical parameters with the least error along recorded tosses, without gradients.

Over an impact the slope of a rollout says nothing of its neighbours, so that the error is
modelled from its values alone: COBYQA (T. M. Ragonneau, PhD thesis, 2022), scipy's
trust-region method with quadratic models. Flight alone tells gravity and the centre of
mass, by least squares.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Generator, Tensor

from torchrl_nerd.analytic.free_body import SCALED, SHIFTED
from torchrl_nerd.data.cube_tosses import Tosses
from torchrl_nerd.geometry.rotations import rotate_inverse
from torchrl_nerd.modules.pose_encoder import CLEAR
from torchrl_nerd.scenes import Scene

WINDOWS = (150, 400)  # sub-trajectories: first coarsely, then finely
RADII = (0.2, 0.1)  # of the first steps, in units of `SCALED` and `SHIFTED`
CLOSE = 0.004  # the same of the last
POSITION, ORIENTATION = 0.01, 0.2  # m and rad that weigh alike
LOST = 1e3  # score of parameters with which a rollout breaks
SHORTEST = 8  # frames of a flight that tells anything
CENTRE = ("centre_x", "centre_y", "centre_z")

Errors = tuple[Tensor, Tensor]


def fit_parameters(
    errors_of: Callable[[dict[str, float], Tensor], Errors],
    first: dict[str, float],
    names: Sequence[str],
    starts: Tensor,
    evaluations: int,
    seed: int = 0,
) -> Iterator[dict[str, float]]:
    """Parameters with the least error after each stage: few sub-trajectories, then more.

    Args:
        errors_of: of parameters and rows of first states, to distances (m) and angles
            (rad) ``(windows, steps)``.
        first: parameters to begin with.
        names: which of them to change.
        starts: rows of the first states of training sub-trajectories, to draw from.
        evaluations: of each stage.
        seed: of the draw.
    """
    generator = Generator().manual_seed(seed)
    order = torch.randperm(len(starts), generator=generator)
    for windows, radius in zip(WINDOWS, RADII, strict=True):
        score = partial(_score, errors_of, first, names, starts[order[:windows]])
        options = {
            "maxfev": evaluations,
            "initial_tr_radius": radius,
            "final_tr_radius": CLOSE,
        }
        found = minimize(score, np.zeros(len(names)), method="COBYQA", options=options)
        first = moved(first, names, found.x)
        yield first


def _score(
    errors_of: Callable[[dict[str, float], Tensor], Errors],
    origin: dict[str, float],
    names: Sequence[str],
    rows: Tensor,
    x: np.ndarray,
) -> float:
    distance, angle = errors_of(moved(origin, names, x), rows)
    error = distance.mean() / POSITION + angle.mean() / ORIENTATION
    return float(error) if error.isfinite() else LOST


def moved(
    values: dict[str, float], names: Sequence[str], x: np.ndarray
) -> dict[str, float]:
    """Parameters with those named changed by ``x``, in units of `SCALED`, `SHIFTED`."""
    after = dict(values)
    for name, by in zip(names, x.tolist(), strict=True):
        if name in SCALED:
            after[name] = values[name] * float(np.exp(SCALED[name] * by))
        else:
            after[name] = values[name] + SHIFTED[name] * by
    return after


def fit_flight(scene: Scene, tosses: Tosses, every: int = 1) -> dict[str, float]:
    """Gravity (m/s^2) and centre of mass (m, body axes) from the tosses' first flights.

    The body's frame is where its centre of mass is, less the turned offset between them:
    ``p + R c = p0 + v0 t - g t^2 / 2``, linear in all unknowns. Empty where no toss flies
    long enough.

    Args:
        scene: of the body.
        tosses: recorded.
        every: frames between those that are looked at.
    """
    flies = scene.clearances(tosses.qpos).amin(-1) > CLEAR
    rows, values = [], []
    for first, end in zip(tosses.offsets[:-1], tosses.offsets[1:], strict=True):
        down = (~flies[first:end]).nonzero()
        count = int(down[0]) if len(down) else int(end - first)
        if count < SHORTEST:
            continue
        qpos = tosses.qpos[first : first + count : every]
        time = scene.control_step * every * torch.arange(len(qpos)).to(qpos)
        line = torch.stack((torch.ones_like(time), time), 1)
        apart = torch.eye(len(qpos)).to(qpos) - line @ torch.linalg.pinv(line)
        axes = torch.eye(3).to(qpos)
        for axis in range(3):
            arm = rotate_inverse(qpos[:, 3:7], axes[axis].expand(len(qpos), 3))
            drop = 0.5 * time.square() * (axis == 2)
            rows.append(apart @ torch.cat((-arm, -drop[:, None]), 1))
            values.append(apart @ qpos[:, axis])
    if not rows:
        return {}
    found = torch.linalg.lstsq(torch.cat(rows), torch.cat(values)[:, None]).solution
    return dict(zip((*CENTRE, "gravity"), found[:, 0].tolist(), strict=True))
