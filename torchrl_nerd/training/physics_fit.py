"""Physical parameters with the least error along recorded trajectories, without gradients.

Over an impact the slope of a rollout says little of its neighbours, so the error is
modelled from its values alone: COBYQA (T. M. Ragonneau, PhD thesis, 2022), scipy's
trust-region method with quadratic models. Gravity and the centre of mass follow from
flight alone, by least squares.
"""

from collections.abc import Callable, Iterator, Sequence

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Generator, Tensor

from torchrl_nerd.analytic.free_body import SCALED, SHIFTED
from torchrl_nerd.data.recorded import CLEAR, Recording
from torchrl_nerd.geometry.rotations import rotate_inverse
from torchrl_nerd.scenes import Scene

WINDOWS = (150, 400)  # of the two stages: first coarsely, then finely
RADII = (0.2, 0.1)  # of the first steps, in units of `SCALED` and `SHIFTED`
CLOSE = 0.004  # the same of the last
LOST = 1e3  # error of parameters with which a rollout is not finite
SHORTEST = 0.05  # s of a flight that counts
OBSERVABLE = 1e-6  # least singular value that flights show, a share of the largest
CENTRE = ("centre_x", "centre_y", "centre_z")


def fit_parameters(
    error_of: Callable[[dict[str, float], Tensor], float],
    first: dict[str, float],
    names: Sequence[str],
    starts: Tensor,
    evaluations: int,
    seed: int = 0,
) -> Iterator[dict[str, float]]:
    """Parameters with the least error after each stage: few windows, then more.

    Args:
        error_of: parameters and frames of first states -> error, near 1.
        first: parameters to begin with.
        names: which of them to change.
        starts: frames of the first states of training windows, to draw from.
        evaluations: of ``error_of``, in each stage.
        seed: of the draw.
    """
    generator = Generator().manual_seed(seed)
    order = torch.randperm(len(starts), generator=generator)
    for windows, radius in zip(WINDOWS, RADII, strict=True):
        origin, frames = first, starts[order[:windows]]

        def score(
            x: np.ndarray, origin: dict = origin, frames: Tensor = frames
        ) -> float:
            error = error_of(moved(origin, names, x), frames)
            return error if np.isfinite(error) else LOST

        radii = {"initial_tr_radius": radius, "final_tr_radius": CLOSE}
        options = {"maxfev": evaluations, **radii}
        found = minimize(score, np.zeros(len(names)), method="COBYQA", options=options)
        first = moved(origin, names, found.x)
        yield first


def moved(
    values: dict[str, float], names: Sequence[str], x: np.ndarray
) -> dict[str, float]:
    """Parameters with those named changed by ``x``, in units of `SCALED`, `SHIFTED`."""
    after = dict(values)
    for name, by in zip(names, x.tolist(), strict=True):
        if name in SCALED:
            after[name] *= float(np.exp(SCALED[name] * by))
        else:
            after[name] += SHIFTED[name] * by
    return after


def fit_flight(scene: Scene, recording: Recording) -> dict[str, float]:
    """Gravity (m/s^2) and centre of mass (m, body axes) from first flights.

    The centre of mass ``p + R c`` of a body at ``p``, turned by ``R``, draws a parabola:
    ``p + R c = p0 + v0 t - g t^2 / 2``, linear in all unknowns. Empty where no trajectory
    is off the ground long enough.
    """
    gaps = scene.clearances(recording.qpos, recording.terrain)
    is_airborne = (gaps > CLEAR).all(-1)
    rows, values = [], []
    for trajectory in recording.trajectories:
        # until it first lands
        count = int(is_airborne[trajectory].long().cumprod(0).sum())
        if count < 3 or count * recording.frame < SHORTEST:
            continue
        qpos = recording.qpos[trajectory][:count]
        time = recording.frame * torch.arange(count).to(qpos)
        line = torch.stack((torch.ones_like(time), time), 1)
        # takes p0 and v0 t out of all that follows: (count, count)
        apart = torch.eye(count).to(qpos) - line @ torch.linalg.pinv(line)
        axes = torch.eye(3).to(qpos)
        for axis in range(3):
            arm = rotate_inverse(qpos[:, 3:7], axes[axis].expand(count, 3))
            drop = 0.5 * time.square() * (axis == 2)
            rows.append(apart @ torch.cat((-arm, -drop[:, None]), 1))
            values.append(apart @ qpos[:, axis])
    if not rows:
        return {}
    # a centre of mass that nothing shows, as where no body turns, stays at zero
    how = {"rcond": OBSERVABLE, "driver": "gelsd"}
    found = torch.linalg.lstsq(torch.cat(rows), torch.cat(values)[:, None], **how)[0]
    return dict(zip((*CENTRE, "gravity"), found[:, 0].tolist(), strict=True))
