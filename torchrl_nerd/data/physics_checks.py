"""Units and frames of a log, checked by physics: a free body falls at 9.81 m/s^2.

Each check has a value and a range that it must lie in. A log outside is refused with the
check's name, its value and, where another reading would fit, that reading. Of robots that
are not a single free body, time stamps, quaternions and velocities are checked.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchrl_nerd.data.recorded import (
    Recording,
    backward_differences,
    free_fall,
    is_free_body,
)
from torchrl_nerd.geometry.manifold import normalize_pos
from torchrl_nerd.geometry.rotations import quat_normalize, rotate
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.support import DISABLE

UNIT_ERROR = 1e-3  # of a quaternion's length
GRAVITY_ERROR = 0.05  # of gravity: the published recordings are 2% short
USUAL_GRAVITY = 9.81  # m/s^2, of which the error is a share where there is none
DEEPEST = 0.2  # of the robot's size that points may lie under the ground
VELOCITY_ERROR = 0.25  # of the median speed, measured against differences of poses
LARGEST_JUMP = 0.5  # of a frame's displacement that its velocity does not explain
LARGEST_EXCESS = 0.2  # of a frame's speed, above that of both its neighbours
STILL = 1e-2  # m/s and rad/s: slower frames tell no units
SLOW = 0.3  # m/s added to speeds: noise counts for more in slow frames
WXYZ = [6, 3, 4, 5]  # columns of a free body's qpos, if its quaternion is xyzw


@dataclass(frozen=True)
class Check:
    """A value, and the range ``low`` to ``high`` that it must lie in."""

    name: str
    value: float
    low: float
    high: float
    unit: str
    advice: str  # the reading that would fit, or what is usually wrong

    @property
    def passes(self) -> bool:
        """Whether the value is in its range."""
        return self.low <= self.value <= self.high

    def __str__(self) -> str:
        low = "at most" if self.low == -float("inf") else f"{self.low:.3g} to"
        limits = f"{low} {self.high:.3g}"
        return f"{self.name}: {self.value:.3g} {self.unit}, expected {limits}"


def check_log(log: Recording, scene: Scene) -> list[Check]:
    """All checks that the log can answer.

    Raises:
        ValueError: in one sentence, the first check that failed.
    """
    done = []
    for check in _checks(log, scene):
        if not check.passes:
            raise ValueError(f"the log fails the physics check {check}: {check.advice}")
        done.append(check)
    return done


def _checks(log: Recording, scene: Scene) -> Iterator[Check]:
    quats = [log.qpos[:, q : q + 4] for q, _ in scene.layout.rotations]
    if quats:
        worst = float((_length(torch.stack(quats)) - 1.0).abs().max())
        name, advice = "length of quaternions less 1", "expected unit quaternions"
        yield Check(name, worst, 0.0, UNIT_ERROR, "", advice)
    if log.time is not None:
        steps = log.time.diff()[log.inside[1:]] / log.frame
        uneven = "time must rise evenly within a trajectory"
        gap = "there is a gap in time: split the trajectory there"
        for step, advice in ((steps.min(), uneven), (steps.max(), gap)):
            limits = 0.5, 1.5, "frames"
            yield Check("time between frames", float(step), *limits, advice)
        ratio = log.frame / scene.control_step
        name = "frame over the scene's control step"
        advice = "resample the log to the scene's control step"
        yield Check(name, ratio, 0.95, 1.05, "", advice)
    if is_free_body(scene):
        yield from _free_body_checks(log, scene)
    elif not log.qvel.isnan().any():
        mean = backward_differences(log, scene)
        advice = "velocities are in other units, or frames are of another length"
        nearest = _between(log.qvel, mean)
        yield _velocity("qvel against differences of qpos", nearest, mean, log, advice)


def _free_body_checks(log: Recording, scene: Scene) -> Iterator[Check]:
    yield _gravity(free_fall(log), scene)
    # the log if its quaternions are xyzw
    swapped = replace(log, qpos=log.qpos[:, [0, 1, 2, *WXYZ]])
    if len(scene.contacts):
        yield _depth(log, swapped, scene)
    linear, angular = log.qvel.split(3, -1)  # (N, 3) each
    moved, turned = backward_differences(log, scene).split(3, -1)  # the same, measured
    quat = quat_normalize(log.qpos[:, 3:])
    has_linear = not linear.isnan().any()
    if has_linear:
        name = "linear velocity against differences of positions"
        speeds = (float(_length(x).median()) for x in (moved, linear))
        advice = "positions move at {:.3g} m/s (median), velocities say {:.3g} m/s"
        advice = advice.format(*speeds)
        other = "they are read in body axes: give them in world axes"
        readings = {other: (rotate(quat, linear), moved)}
        yield _velocity(name, linear, moved, log, advice, readings)
    if not angular.isnan().any():
        name = "angular velocity in body axes against differences of quaternions"
        advice = "quaternions or angular velocities are in other frames or units"
        own, axes = "angular velocities are", "world axes: give them in body axes"
        order = "quaternions are xyzw: give them as wxyz"
        readings = {
            f"{own} in {axes}": (angular, rotate(quat, turned)),
            order: (angular, backward_differences(swapped, scene)[:, 3:]),
            f"{own} in degrees: give them in rad/s": (torch.deg2rad(angular), turned),
        }
        yield _velocity(name, angular, turned, log, advice, readings)
    if has_linear:
        jump = _length(moved - _between(linear, moved)) / (_length(linear) + SLOW)
        name = "displacement within a frame that no velocity explains"
        yield _gap(name, torch.where(log.inside, jump, 0.0), LARGEST_JUMP)
    # The velocity over a frame with an impact is a mean of those around it, so no impact
    # makes it larger than both; lost frames do.
    speed = _length(moved)
    around = torch.maximum(speed.roll(1), speed.roll(-1))
    excess = (speed - around).clamp_min(0.0) / (around + SLOW)
    excess = torch.where(log.inside & log.inside.roll(-1), excess, 0.0)
    name = "speed of a frame above that of both its neighbours"
    yield _gap(name, excess, LARGEST_EXCESS)


def _gravity(fall: Tensor, scene: Scene) -> Check:
    """Acceleration along z over the first frames of each trajectory, by a parabola."""
    weight = 1.0 - float(scene.model.body_gravcomp[scene.base.body])
    if scene.model.opt.disableflags & DISABLE.mjDSBL_GRAVITY:
        weight = 0.0
    expected = weight * float(scene.model.opt.gravity[2])
    margin = GRAVITY_ERROR * max(abs(expected), USUAL_GRAVITY)
    value, sideways = float(fall[2]), fall[:2].abs()
    advice = f"positions in other units or frames of another length ({value:.3g} m/s^2)"
    if float(sideways.max()) > abs(value):
        axis = "xy"[int(sideways.argmax())]
        advice = f"the world's {axis} axis falls, z should point up"
    elif value > 0.0:
        advice = "z points down, it should point up"
    elif value < 0.0 and expected < 0.0:
        advice = f"positions fit if multiplied by about {expected / value:.2g}"
    limits = expected - margin, expected + margin
    return Check("free fall along z", value, *limits, "m/s^2", advice)


def _depth(log: Recording, swapped: Recording, scene: Scene) -> Check:
    """How deep the lowest contact point ever lies in the ground."""
    found, if_swapped = (
        -float(scene.clearances(normalize_pos(scene.layout, x.qpos), x.terrain).min())
        for x in (log, swapped)
    )
    limit = DEEPEST * float(abs(scene.contacts.positions).max())
    advice = "sizes, or the ground's height, differ from the scene's"
    if if_swapped < limit:
        advice = "it fits if quaternions are read as xyzw: give them as wxyz"
    name = "deepest corner under the ground"
    return Check(name, found, -float("inf"), limit, "m", advice)


def _velocity(
    name: str,
    stored: Tensor,
    measured: Tensor,
    log: Recording,
    advice: str,
    readings: Mapping[str, tuple[Tensor, Tensor]] | None = None,
) -> Check:
    """Median difference over the median speed, of frames that move within a trajectory.

    ``readings``: other pairs of velocities, which are advised if they agree.
    """

    def error(stored: Tensor, measured: Tensor) -> float:
        apart, speed = _length(stored - measured), _length(measured)
        moves = log.inside & (torch.maximum(apart, speed) > STILL)
        if not moves.any():
            return 0.0
        return float(apart[moves].median() / speed[moves].median().clamp_min(STILL))

    for reading, pair in (readings or {}).items():
        if error(*pair) < VELOCITY_ERROR:
            advice = f"it fits if {reading}"
            break
    found = error(stored, measured)
    return Check(name, found, 0.0, VELOCITY_ERROR, "of the speed", advice)


def _gap(name: str, values: Tensor, limit: float) -> Check:
    """The largest of the frames' ``values (N,)``, and where it is."""
    frame = int(values.argmax())
    advice = f"there is a gap in time, or frames are lost, before frame {frame}"
    return Check(name, float(values[frame]), 0.0, limit, "of it", advice)


def _between(ends: Tensor, mean: Tensor) -> Tensor:
    """What is nearest to the ``mean`` velocity of a frame, between those at its ends.

    Dampers and impacts change a velocity within a frame, so it need not be half way.
    """
    before = ends.roll(1, 0)
    return mean.clamp(torch.minimum(before, ends), torch.maximum(before, ends))


def _length(x: Tensor) -> Tensor:
    return torch.linalg.vector_norm(x, dim=-1)
