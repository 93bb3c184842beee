"""Initial states for training: drawn from a scene's ranges, clear of the ground."""

from collections.abc import Callable

import torch
from torch import Generator, Tensor

from torchrl_nerd.geometry.manifold import JointLayout
from torchrl_nerd.geometry.rotations import quat_normalize
from torchrl_nerd.scenes.sampling import Sampling, sample_scale, uniform

MAX_REDRAWS = 300  # of states that are not clear of the ground


def draw_initial(
    sampling: Sampling,
    layout: JointLayout,
    rows: int,
    generator: Generator,
    clearances: Callable[[Tensor], Tensor],
) -> tuple[dict[str, Tensor], Tensor]:
    """Initial states and each one's torque scale ``(rows, 1)``; see `Scene.sample_initial`.

    Args:
        sampling: the ranges.
        layout: of the robot's joints.
        rows: how many.
        generator: of all random numbers.
        clearances: of ``qpos (n, nq)``: gaps of contact points to the ground ``(n, P)``, m.

    Raises:
        ValueError: no state within the ranges is clear of the ground.
    """
    if sampling.starts is not None:
        state = dict(sampling.starts(rows, generator))
        torque_scale, _ = sample_scale(sampling, rows, generator)
    else:
        qpos, qvel = _draw_clear(sampling, layout, rows, generator, clearances)
        torque_scale, speed_scale = sample_scale(sampling, rows, generator)
        state = {"qpos": qpos, "qvel": speed_scale * qvel}
    if sampling.ground is not None and "terrain" not in state:
        state["terrain"] = sampling.ground(state["qpos"], generator)
    return state, torque_scale


def _draw_clear(
    sampling: Sampling,
    layout: JointLayout,
    rows: int,
    generator: Generator,
    clearances: Callable[[Tensor], Tensor],
) -> tuple[Tensor, Tensor]:
    """Positions and velocities within the ranges, clear of the ground."""
    qpos, qvel = _draw(sampling, layout, rows, generator)
    if sampling.clearance is None:
        return qpos, qvel
    for _ in range(MAX_REDRAWS):
        is_low = clearances(qpos).amin(-1) < sampling.clearance
        if not is_low.any():
            return qpos, qvel
        again = _draw(sampling, layout, int(is_low.sum()), generator)
        qpos[is_low], qvel[is_low] = again
    raise ValueError(
        f"expected ranges with states clear of the ground, found none in {MAX_REDRAWS} "
        "draws: give others, or clearance=None"
    )


def _draw(
    sampling: Sampling, layout: JointLayout, rows: int, generator: Generator
) -> tuple[Tensor, Tensor]:
    """Positions and velocities within the ranges."""
    qpos = uniform(sampling.qpos_low, sampling.qpos_high, rows, generator)
    qvel = uniform(sampling.qvel_low, sampling.qvel_high, rows, generator)
    if sampling.base is not None:
        base_pos, base_vel = sampling.base.draw(rows, generator)
        qpos = torch.cat((base_pos, qpos), -1)
        qvel = torch.cat((base_vel, qvel), -1)
    for q, _ in layout.rotations:
        qpos[:, q : q + 4] = quat_normalize(qpos[:, q : q + 4])
    return qpos, qvel
