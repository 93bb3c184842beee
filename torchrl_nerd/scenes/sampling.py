"""Where training trajectories start and what drives them."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Generator, Tensor

from torchrl_nerd.geometry.frames import quat_multiply, random_tilt, rotate

GroundSampler = Callable[[Tensor, Generator], Tensor]
"""``(qpos (n, nq), generator) -> terrain (n, terrain.size)``."""

Drive = Callable[[Tensor, Tensor, Tensor, Generator], Tensor]
"""``(qpos, qvel, scale (n, 1), generator) -> joint_torque (n, num_actuated)``."""

Triple = tuple[float, float, float]


@dataclass(frozen=True)
class BaseSampling:
    """Where a floating base starts.

    | field | meaning |
    |---|---|
    | ``low``, ``high`` | position of the base, m, world |
    | ``tilt`` | turned by U(-1, 1) times this angle (rad) about a random axis |
    | ``linear_low``, ``linear_high`` | velocity of its origin, m/s, base frame |
    | ``angular_low``, ``angular_high`` | angular velocity, rad/s, base frame |
    | ``quat`` | the orientation that is turned, wxyz |

    The axis is a normalised U(-1, 1)^3, as in the reference code.
    """

    low: Triple
    high: Triple
    tilt: float
    linear_low: Triple
    linear_high: Triple
    angular_low: Triple
    angular_high: Triple
    quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)

    def draw(self, rows: int, generator: Generator) -> tuple[Tensor, Tensor]:
        """``qpos (rows, 7)`` and ``qvel (rows, 6)`` of the free joint, float64."""
        position = uniform(self.low, self.high, rows, generator)
        axis, angle = (
            torch.rand(rows, size, dtype=torch.float64, generator=generator)
            for size in (3, 1)
        )
        upright = torch.tensor(self.quat, dtype=torch.float64).expand(rows, 4)
        tilt = random_tilt(torch.cat((axis, angle), -1), self.tilt)
        quat = quat_multiply(upright, tilt)
        linear = uniform(self.linear_low, self.linear_high, rows, generator)
        angular = uniform(self.angular_low, self.angular_high, rows, generator)
        qvel = torch.cat((rotate(quat, linear), angular), -1)
        return torch.cat((position, quat), -1), qvel


@dataclass(frozen=True)
class Sampling:
    """Uniform ranges of initial states and torques.

    | field | meaning |
    |---|---|
    | ``qpos_low``, ``qpos_high`` | initial positions of the joints, m and rad |
    | ``qvel_low``, ``qvel_high`` | initial velocities of the joints, m/s and rad/s |
    | ``torque`` | largest torque of each actuated dof, N and N m |
    | ``base`` | start of a floating base, whose joint comes before the others |
    | ``ground`` | draws each row's ground, where it varies |
    | ``drive`` | torques that depend on the state, in place of uniform ones |
    | ``clearance`` | starts nearer to the ground than this (m) are drawn again |
    | ``passive_share`` | share of trajectories with no torque at all |
    | ``quiet_share`` | share whose torque and velocity are scaled down by U(0, 1) |
    """

    qpos_low: tuple[float, ...]
    qpos_high: tuple[float, ...]
    qvel_low: tuple[float, ...]
    qvel_high: tuple[float, ...]
    torque: tuple[float, ...]
    base: BaseSampling | None = None
    ground: GroundSampler | None = None
    drive: Drive | None = None
    clearance: float | None = None
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
