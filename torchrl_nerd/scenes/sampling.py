"""Where training trajectories start and what drives them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from math import log
from typing import Any

import torch
from torch import Generator, Tensor

from torchrl_nerd.geometry.manifold import JointLayout
from torchrl_nerd.geometry.rotations import quat_normalize, random_tilt, rotate
from torchrl_nerd.scenes.controllers import Row
from torchrl_nerd.settings import expect_share

GroundSampler = Callable[[Tensor, Generator], Tensor]
"""``(qpos (n, nq), generator) -> terrain (n, terrain.size)``."""

Drive = Callable[[Tensor, Tensor, Tensor, Generator], Tensor]
"""``(qpos, qvel, scale (n, 1), generator) -> joint_torque (n, num_actuated)``."""

Starts = Callable[[int, Generator], dict[str, Tensor]]
"""``(count, generator) -> qpos (count, nq), qvel (count, nv)``, perhaps ``terrain``."""

MAX_REDRAWS = 300  # of states that are not clear of the ground or of the robot itself


@dataclass(frozen=True)
class BaseSampling:
    """Where a floating base starts."""

    low: Row  # position of the base, m, world
    high: Row
    tilt: float  # turned by U(-1, 1) times this angle (rad), see `random_tilt`
    linear_low: Row  # velocity of its origin, m/s, base frame
    linear_high: Row
    angular_low: Row  # rad/s, base frame
    angular_high: Row

    def draw(self, count: int, generator: Generator) -> tuple[Tensor, Tensor]:
        """``qpos (count, 7)`` and ``qvel (count, 6)`` of the free joint, float64."""
        position = uniform(self.low, self.high, count, generator)
        axis = torch.rand(count, 3, dtype=torch.float64, generator=generator)
        angle = torch.rand(count, 1, dtype=torch.float64, generator=generator)
        quat = random_tilt(torch.cat((axis, angle), -1), self.tilt)
        linear = uniform(self.linear_low, self.linear_high, count, generator)
        angular = uniform(self.angular_low, self.angular_high, count, generator)
        qvel = torch.cat((rotate(quat, linear), angular), -1)
        return torch.cat((position, quat), -1), qvel


@dataclass(frozen=True)
class Sampling:
    """Uniform ranges of initial states and torques.

    Raises:
        ValueError: a fraction outside [0, 1], a scale or times that are not positive and
            in order, or a correlation beside a ``drive``, whose torques follow the state.
    """

    qpos_low: Row  # initial positions of the joints, m and rad
    qpos_high: Row
    qvel_low: Row  # initial velocities of the joints, m/s and rad/s
    qvel_high: Row
    torque: Row  # largest torque of each actuated dof, N and N m
    # start of a floating base, whose joint comes before the others
    base: BaseSampling | None = None
    ground: GroundSampler | None = None  # draws that of each state, where it varies
    # draws grounds that the robot hits head-on, see `data.strategies`
    level_ground: GroundSampler | None = None
    drive: Drive | None = None  # torques that depend on the state, not uniform ones
    clearance: float | None = None  # m: starts nearer to the ground are drawn again
    # m: starts with a deeper contact, of the robot with the ground or with itself, are
    # drawn again; of draws that are all deeper the least deep one stays
    penetration: float | None = None
    zero_torque_fraction: float = 0.25  # share of trajectories with no torque at all
    # share whose torque and velocity are scaled down by U(0, 1)
    low_torque_fraction: float = 0.25
    starts: Starts | None = None  # draws the initial states, in place of the ranges
    # torque scales of the other trajectories are log-uniform from this to 1
    min_torque_scale: float | None = None
    # shortest and longest correlation time of torques, s; None: drawn at every step
    correlation_time: tuple[float, float] | None = None
    # lowest and highest control of each servo, drawn in place of torques
    ctrl: tuple[Row, Row] | None = None

    def __post_init__(self) -> None:
        least, times = self.min_torque_scale, self.correlation_time
        fractions = "zero_torque_fraction", "low_torque_fraction"
        expect_share(**{name: getattr(self, name) for name in fractions})
        if least is not None and not 0.0 < least <= 1.0:
            raise ValueError(
                f"expected a min_torque_scale above 0 and up to 1, got {least}"
            )
        if times is not None and not 0.0 < times[0] <= times[1]:
            wanted = "two correlation times above 0 s, the lower first"
            raise ValueError(f"expected {wanted}, got {times}")
        if times is not None and self.drive is not None:
            raise ValueError(
                "expected a correlation time or a drive, got both: a drive's torques "
                "follow the state"
            )

    def expect_sizes(self, layout: JointLayout, num_actuated: int) -> None:
        """Raise a ValueError where a range is not one number for each entry, in order."""
        free_q, free_v = (7, 6) if self.base is not None else (0, 0)
        sizes = {"torque": num_actuated}
        self._expect_order()
        if self.starts is None:
            sizes |= dict.fromkeys(("qpos_low", "qpos_high"), layout.nq - free_q)
            sizes |= dict.fromkeys(("qvel_low", "qvel_high"), layout.nv - free_v)
        for name, size in sizes.items():
            if (count := len(getattr(self, name))) != size:
                raise ValueError(f"expected {name} of length {size}, got {count}")

    def _expect_order(self) -> None:
        """Raise a ValueError for a range whose low end is not below its high one."""
        ranges = [("torque", (0.0,) * len(self.torque), self.torque)]
        ranges += [("qpos", self.qpos_low, self.qpos_high)]
        ranges += [("qvel", self.qvel_low, self.qvel_high)]
        if self.ctrl is not None:
            ranges += [("ctrl", *self.ctrl)]
        if (base := self.base) is not None:
            three = [("base", base.low, base.high)]
            three += [("base.linear", base.linear_low, base.linear_high)]
            three += [("base.angular", base.angular_low, base.angular_high)]
            for name, *ends in three:
                if [*map(len, ends)] != [3, 3]:
                    raise ValueError(f"expected {name} of three numbers, got {ends}")
            ranges += [*three, ("base.tilt", (0.0,), (base.tilt,))]
        for name, *ends in ranges:
            for low, high in zip(*ends, strict=False):  # not read beside ``starts``
                if not low <= high:
                    raise ValueError(
                        f"expected {name} from low to high, got {low} and {high}"
                    )

    @property
    def commands(self) -> tuple[Tensor, Tensor]:
        """Middle and half width ``(m,)`` of what is drawn: torques, or servos' controls."""
        if self.ctrl is None:
            half = torch.tensor(self.torque, dtype=torch.float64)
            return torch.zeros_like(half), half
        low, high = torch.tensor(self.ctrl, dtype=torch.float64)
        return 0.5 * (low + high), 0.5 * (high - low)

    def ranges(self) -> dict[str, Any]:
        """What cards say: every field that is set, but for functions."""
        found = {field.name: getattr(self, field.name) for field in fields(self)}
        if self.base is not None:
            found["base"] = vars(self.base).copy()
        return {k: v for k, v in found.items() if v is not None and not callable(v)}


def draw_initial(
    sampling: Sampling,
    layout: JointLayout,
    count: int,
    generator: Generator,
    clearances: Callable[[Tensor], Tensor],
    depths: Callable[[Tensor], Tensor],
) -> tuple[dict[str, Tensor], Tensor]:
    """Initial states, torque scales ``(count, 1)``; see `Scene.sample_initial`.

    Of ``qpos (n, nq)``, ``clearances`` are gaps of contact points to the ground ``(n, P)``
    and ``depths`` of the deepest contact ``(n,)``, m.

    Raises:
        ValueError: no state within the ranges is clear of the ground.
    """

    def draw(count: int) -> tuple[Tensor, ...]:
        """States, and by how much they are too near to the ground, and too deep, m."""
        qpos, qvel = _draw(sampling, layout, count, generator)
        low = deep = qpos.new_zeros(count)
        if sampling.clearance is not None and (gaps := clearances(qpos)).shape[-1]:
            low = (sampling.clearance - gaps.amin(-1)).clamp_min(0.0)  # of (n, P)
        if sampling.penetration is not None:
            deep = (depths(qpos) - sampling.penetration).clamp_min(0.0)
        return qpos, qvel, low, deep

    if sampling.starts is not None:
        state = dict(sampling.starts(count, generator))
        torque_scale, _ = sample_scale(sampling, count, generator)
    else:
        qpos, qvel = _draw_clear(count, draw)
        torque_scale, speed_scale = sample_scale(sampling, count, generator)
        state = {"qpos": qpos, "qvel": speed_scale * qvel}
    if sampling.ground is not None and "terrain" not in state:
        state["terrain"] = sampling.ground(state["qpos"], generator)
    return state, torque_scale


def _draw_clear(
    count: int, draw: Callable[[int], tuple[Tensor, ...]]
) -> tuple[Tensor, Tensor]:
    """Positions and velocities, drawn again where they are too near or too deep."""
    drawn = qpos, qvel, low, deep = draw(count)
    for _ in range(MAX_REDRAWS):
        again = (low + deep > 0.0).nonzero()[:, 0]
        if not len(again):
            return qpos, qvel
        new = draw(len(again))
        better = new[2] + new[3] < (low + deep)[again]
        for kept, other in zip(drawn, new, strict=True):
            kept[again[better]] = other[better]
    if low.any():
        raise ValueError(
            f"expected ranges with states clear of the ground, found none in {MAX_REDRAWS} "
            "draws: give others, or clearance=None"
        )
    return qpos, qvel


def _draw(
    sampling: Sampling, layout: JointLayout, count: int, generator: Generator
) -> tuple[Tensor, Tensor]:
    """Positions and velocities within the ranges."""
    qpos = uniform(sampling.qpos_low, sampling.qpos_high, count, generator)
    qvel = uniform(sampling.qvel_low, sampling.qvel_high, count, generator)
    if sampling.base is not None:
        base_pos, base_vel = sampling.base.draw(count, generator)
        qpos, qvel = torch.cat((base_pos, qpos), -1), torch.cat((base_vel, qvel), -1)
    for q, _ in layout.rotations:
        qpos[:, q : q + 4] = quat_normalize(qpos[:, q : q + 4])
    return qpos, qvel


def uniform(
    low: Sequence[float], high: Sequence[float], count: int, generator: Generator
) -> Tensor:
    """Independent uniform numbers ``(count, len(low))``, float64."""
    a, b = torch.tensor([low, high], dtype=torch.float64)
    u = torch.rand(count, len(low), dtype=torch.float64, generator=generator)
    return a + (b - a) * u


def log_uniform(low: float, high: float, count: int, generator: Generator) -> Tensor:
    """Numbers ``(count, 1)`` that are as likely in each octave, float64."""
    u = torch.rand(count, 1, dtype=torch.float64, generator=generator)
    return low * torch.exp(u * log(high / low))


def sample_commands(
    sampling: Sampling, scale: Tensor, steps: int, generator: Generator
) -> Tensor:
    """Uniform torques or controls ``(count, steps, m)``, see `Sampling.commands`.

    Their distance from the middle is times each trajectory's ``scale (count, 1)``.
    """
    count, (middle, half) = len(scale), sampling.commands
    low, high = (-half).tolist(), half.tolist()
    draw = uniform(low, high, steps * count, generator)
    return middle + scale[:, None] * draw.unflatten(0, (steps, count)).transpose(0, 1)


def sample_correlated_commands(
    sampling: Sampling,
    scale: Tensor,
    steps: int,
    control_step: float,
    generator: Generator,
) -> Tensor:
    """Commands of trajectories ``(count, steps, m)``, correlated in time where asked.

    An Ornstein-Uhlenbeck process of each trajectory's correlation time is put through
    its own distribution function: at every step a command is as uniform as without.
    """
    if sampling.correlation_time is None:
        return sample_commands(sampling, scale, steps, generator)
    time = log_uniform(*sampling.correlation_time, len(scale), generator)
    keep = torch.exp(-control_step / time)
    middle, half = sampling.commands
    size = (steps, len(scale), len(half))
    noise = torch.randn(size, dtype=torch.float64, generator=generator)
    walk = [noise[0]]
    for kick in noise[1:]:
        walk.append(keep * walk[-1] + (1.0 - keep**2).sqrt() * kick)
    share = torch.erf(torch.stack(walk, 1) / 2.0**0.5)  # (count, steps, m)
    return middle + scale[:, None] * share * half


def sample_scale(
    sampling: Sampling, count: int, generator: Generator
) -> tuple[Tensor, Tensor]:
    """How violent each trajectory is: scales of torque and velocity ``(count, 1)``.

    Both 1 for most trajectories (torque log-uniform from ``min_torque_scale`` to 1, if
    set); velocity U(0, 1) in the zero-torque fraction, where torque is 0, and in the
    low-torque one, where torque is the same number.
    """
    draw = torch.rand(2, count, 1, dtype=torch.float64, generator=generator)
    loud = torch.ones_like(draw[0])
    is_passive = draw[0] < sampling.zero_torque_fraction
    is_quiet = draw[0] > 1.0 - sampling.low_torque_fraction
    speed = torch.where(is_quiet | is_passive, draw[1], 1.0)
    if sampling.min_torque_scale is not None:
        loud = log_uniform(sampling.min_torque_scale, 1.0, count, generator)
    torque = torch.where(is_passive, 0.0, torch.where(is_quiet, draw[1], loud))
    return torque, speed
