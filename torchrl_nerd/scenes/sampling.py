"""Where training trajectories start and what drives them."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Generator, Tensor

GroundSampler = Callable[[Tensor, Generator], Tensor]
"""``(qpos (n, nq), generator) -> terrain (n, terrain.size)``."""


@dataclass(frozen=True)
class Sampling:
    """Uniform ranges of initial states and torques.

    | field | meaning |
    |---|---|
    | ``qpos_low``, ``qpos_high`` | initial positions, m and rad |
    | ``qvel_low``, ``qvel_high`` | initial velocities, m/s and rad/s |
    | ``torque`` | largest torque of each actuated dof, N and N m |
    | ``ground`` | draws each row's ground, where it varies |
    | ``passive_share`` | share of trajectories with no torque at all |
    | ``quiet_share`` | share whose torque and velocity are scaled down by U(0, 1) |
    """

    qpos_low: tuple[float, ...]
    qpos_high: tuple[float, ...]
    qvel_low: tuple[float, ...]
    qvel_high: tuple[float, ...]
    torque: tuple[float, ...]
    ground: GroundSampler | None = None
    passive_share: float = 0.25
    quiet_share: float = 0.25


def uniform(
    low: tuple[float, ...], high: tuple[float, ...], rows: int, generator: Generator
) -> Tensor:
    """Independent uniform numbers ``(rows, len(low))``, float64."""
    a, b = torch.tensor([low, high], dtype=torch.float64)
    u = torch.rand(rows, len(low), dtype=torch.float64, generator=generator)
    return a + (b - a) * u


def sample_torque(
    sampling: Sampling, scale: Tensor, steps: int, generator: Generator
) -> Tensor:
    """Uniform torques ``(rows, steps, num_actuated)`` times each row's scale."""
    rows, high = len(scale), sampling.torque
    low = tuple(-t for t in high)
    torque = uniform(low, high, steps * rows, generator)
    return scale[:, None] * torque.unflatten(0, (steps, rows)).transpose(0, 1)


def sample_scale(
    sampling: Sampling, rows: int, generator: Generator
) -> tuple[Tensor, Tensor]:
    """How violent each trajectory is: scales of torque and velocity ``(rows, 1)``.

    Both 1 for most rows; torque 0 for the passive share; both U(0, 1) for the quiet one.
    """
    draw = torch.rand(2, rows, 1, dtype=torch.float64, generator=generator)
    one = torch.ones_like(draw[0])
    is_passive = draw[0] < sampling.passive_share
    is_quiet = draw[0] > 1.0 - sampling.quiet_share
    speed = torch.where(is_quiet | is_passive, draw[1], one)
    torque = torch.where(is_passive, 0.0 * one, torch.where(is_quiet, draw[1], one))
    return torque, speed
