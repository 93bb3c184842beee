"""Units and frames of a log, asked of physics: what falls, falls at 9.81 m/s^2.

Each check has a figure and a range that it must lie in. A log outside is refused with the
check's name, its figure and, where another reading would fit, that reading.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from torchrl_nerd.data.cube_tosses import TossLog, backward_differences
from torchrl_nerd.geometry.rotations import quat_normalize, rotate
from torchrl_nerd.scenes import Scene

UNIT_ERROR = 1e-3  # of a quaternion's length
FLIGHT = 8  # frames at the start of a toss, before its first impact
GRAVITY_ERROR = 0.05  # of 9.81: the published recordings are 2% short
DEEPEST = 0.1  # of the robot's width that points may lie under the ground
VELOCITY_ERROR = 0.25  # of the median speed, measured against differences of poses
LARGEST_JUMP = 0.5  # of a frame's displacement that its velocity does not explain
LARGEST_EXCESS = 0.2  # of a frame's speed, above that of both its neighbours
SLOW = 0.3  # m/s added to speeds: noise counts for more in slow frames
FRAME_ERROR = 0.5  # of a frame


@dataclass(frozen=True)
class Check:
    """One question to physics.

    | field | meaning |
    |---|---|
    | ``name`` | what is asked |
    | ``figure`` | what came out |
    | ``low``, ``high`` | what it must lie between |
    | ``unit`` | of all three |
    | ``advice`` | the reading that would fit, or what is usually wrong |
    """

    name: str
    figure: float
    low: float
    high: float
    unit: str
    advice: str

    @property
    def passes(self) -> bool:
        """Whether the figure is in its range."""
        return self.low <= self.figure <= self.high

    def __str__(self) -> str:
        limits = f"{self.low:.3g} to {self.high:.3g}"
        if self.low == -float("inf"):
            limits = f"at most {self.high:.3g}"
        return f"{self.name}: {self.figure:.3g} {self.unit}, expected {limits}"


def check_log(log: TossLog, scene: Scene) -> list[Check]:
    """Ask all questions that the log can answer.

    Raises:
        ValueError: in one sentence, the first check that failed.
    """
    done = []
    for check in _checks(log, scene):
        if not check.passes:
            raise ValueError(f"the log fails the physics check {check}: {check.advice}")
        done.append(check)
    return done


def _checks(log: TossLog, scene: Scene) -> Iterator[Check]:
    length = torch.linalg.vector_norm(log.quaternion, dim=-1)
    worst = float((length - 1.0).abs().max())
    yield Check(
        *("length of quaternions less 1", worst, 0.0, UNIT_ERROR, ""),
        "expected unit quaternions",
    )
    if log.time is not None:
        steps = log.time.diff()[log.inside] / log.frame
        yield Check(
            *("time between frames", float(steps.min()), 1 - FRAME_ERROR, 1.5),
            *("frames", "time must rise evenly within a toss"),
        )
        yield Check(
            *("time between frames", float(steps.max()), 0.5, 1 + FRAME_ERROR),
            *("frames", "there is a gap in time: split the toss there"),
        )
        ratio = log.frame / scene.control_step
        yield Check(
            *("frame over the scene's control step", ratio, 0.95, 1.05, ""),
            "resample the log to the scene's control step",
        )
    yield _gravity(log, scene)
    yield _depth(log, scene)
    linear, angular = backward_differences(log)
    starts = log.offsets[:-1]
    inner = torch.ones(len(linear), dtype=torch.bool)
    inner[starts] = False
    if log.linear is not None:
        error = _relative_error(log.linear, linear, inner)
        yield Check(
            *("linear velocity against differences of positions", error, 0.0),
            *(VELOCITY_ERROR, "of the speed", _linear_advice(log, linear, inner)),
        )
    if log.angular is not None:
        error = _relative_error(log.angular, angular, inner)
        yield Check(
            *("angular velocity in body axes against differences of quaternions",),
            *(error, 0.0, VELOCITY_ERROR, "of the speed"),
            _angular_advice(log, inner),
        )
    if log.linear is not None:
        yield _jump(log.linear, linear, inner)
    yield _excess(linear, inner)


def _gravity(log: TossLog, scene: Scene) -> Check:
    """Acceleration along z over the first frames of each toss, by a parabola."""
    falls = _falls(log)
    expected = float(scene.model.opt.gravity[2])
    margin = GRAVITY_ERROR * abs(expected)
    figure, sideways = float(falls[2]), falls[:2].abs()
    advice = (
        f"positions in other units or frames of another length ({figure:.3g} m/s^2)"
    )
    if float(sideways.max()) > abs(figure):
        axis = "xy"[int(sideways.argmax())]
        advice = f"the world's {axis} axis falls, z should point up"
    elif figure > 0.0:
        advice = "z points down, it should point up"
    elif abs(figure) > 0.0:
        advice = f"positions fit if multiplied by about {expected / figure:.2g}"
    limits = expected - margin, expected + margin
    return Check("free fall along z", figure, *limits, "m/s^2", advice)


def _falls(log: TossLog) -> Tensor:
    """Median over tosses of the acceleration in flight, ``(3,)``, m/s^2."""
    found = []
    for a, b in zip(log.offsets[:-1].tolist(), log.offsets[1:].tolist(), strict=True):
        count = min(FLIGHT, b - a)
        if count < 4:
            continue
        t = log.frame * torch.arange(count, dtype=torch.float64)
        basis = torch.stack((torch.ones_like(t), t, 0.5 * t * t), -1)
        found.append(torch.linalg.lstsq(basis, log.position[a : a + count]).solution[2])
    if not found:
        raise ValueError("expected a toss of at least 4 frames, got none")
    return torch.stack(found).median(0).values


def _depth(log: TossLog, scene: Scene) -> Check:
    """How deep the lowest corner ever lies in the ground."""
    size = float(abs(scene.contacts.positions).max())
    quat = quat_normalize(log.quaternion)
    depth = -_lowest(log.position, quat, scene)
    advice = "sizes, or the ground's height, differ from the scene's"
    swapped = -_lowest(log.position, quat[:, [3, 0, 1, 2]], scene)
    if swapped.max() < 2.0 * DEEPEST * size:
        advice = "it fits if quaternions are read as xyzw: give them as wxyz"
    return Check(
        *("deepest corner under the ground", float(depth.max())),
        *(-float("inf"), 2.0 * DEEPEST * size, "m", advice),
    )


def _lowest(position: Tensor, quat: Tensor, scene: Scene) -> Tensor:
    """Clearance of the lowest corner, m, ``(N,)``."""
    return scene.clearances(torch.cat((position, quat), -1)).amin(-1)


def _relative_error(stored: Tensor, measured: Tensor, inner: Tensor) -> float:
    apart = torch.linalg.vector_norm(stored - measured, dim=-1)[inner]
    speed = torch.linalg.vector_norm(measured, dim=-1)[inner]
    return float(apart.median() / speed.median().clamp_min(1e-9))


def _linear_advice(log: TossLog, measured: Tensor, inner: Tensor) -> str:
    stored = log.linear
    assert stored is not None
    turned = rotate(quat_normalize(log.quaternion), stored)
    if _relative_error(turned, measured, inner) < VELOCITY_ERROR:
        return "it fits if they are read in body axes: give them in world axes"
    sizes = (torch.linalg.vector_norm(x, dim=-1)[inner] for x in (measured, stored))
    ratio = float(torch.stack([x.median() for x in sizes])[0])
    own = float(torch.linalg.vector_norm(stored, dim=-1)[inner].median())
    return f"positions move at {ratio:.3g} m/s (median), velocities say {own:.3g} m/s"


def _angular_advice(log: TossLog, inner: Tensor) -> str:
    stored = log.angular
    assert stored is not None
    quat = quat_normalize(log.quaternion)
    own = backward_differences(log)[1]
    swapped = TossLog(
        *(log.position, quat[:, [3, 0, 1, 2]], None, None, log.offsets, log.time)
    )
    readings = {
        "angular velocities are in world axes: give them in body axes": (
            *(stored, rotate(quat, own)),
        ),
        "quaternions are xyzw: give them as wxyz": (
            *(stored, backward_differences(swapped)[1]),
        ),
        "angular velocities are in degrees: give them in rad/s": (
            *(torch.deg2rad(stored), own),
        ),
    }
    for reading, (a, b) in readings.items():
        if _relative_error(a, b, inner) < VELOCITY_ERROR:
            return f"it fits if {reading}"
    return "quaternions or angular velocities are in other frames or units"


def _jump(stored: Tensor, linear: Tensor, inner: Tensor) -> Check:
    """Largest displacement within a frame that the recorded velocity does not explain."""
    apart = torch.linalg.vector_norm(linear - stored, dim=-1)
    ratio = apart / (torch.linalg.vector_norm(stored, dim=-1) + SLOW)
    return _gap(
        "displacement within a frame that no velocity explains",
        *(torch.where(inner, ratio, 0.0), LARGEST_JUMP),
    )


def _excess(linear: Tensor, inner: Tensor) -> Check:
    """How much faster a frame is than the ones before and after it.

    The velocity over a frame with an impact is a mean of those around it, so that no impact
    makes it larger than both; lost frames do.
    """
    speed = torch.linalg.vector_norm(linear, dim=-1)
    around = torch.maximum(speed.roll(1), speed.roll(-1))
    excess = (speed - around).clamp_min(0.0) / (around + SLOW)
    return _gap(
        "speed of a frame above that of both its neighbours",
        *(torch.where(inner & inner.roll(-1), excess, 0.0), LARGEST_EXCESS),
    )


def _gap(name: str, figures: Tensor, limit: float) -> Check:
    """The largest of the frames' ``figures (N,)``, and where it is."""
    row = int(figures.argmax())
    advice = f"there is a gap in time, or frames are lost, before row {row}"
    return Check(name, float(figures[row]), 0.0, limit, "of it", advice)
