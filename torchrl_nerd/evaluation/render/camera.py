"""Where the picture is taken from: one camera for both sides, so that they compare."""

from dataclasses import dataclass, replace
from functools import cached_property
from math import atan2, cos, degrees, radians, sin, tan

import numpy as np
from torch import Tensor

from torchrl_nerd.evaluation.render.poser import Poser

FIELD_OF_VIEW = 45.0  # degrees, vertical, MuJoCo's default
MARGIN = 1.15
OBLIQUE, ABOVE = (125.0, -18.0), (90.0, -75.0)  # azimuth and elevation, degrees
SIDE = -8.0  # elevation, degrees
SMOOTHING = 0.25  # s: how lazily the camera follows


@dataclass(frozen=True, eq=False)
class Camera:
    """MuJoCo's free camera: looks at a point from a distance.

    | field | meaning |
    |---|---|
    | ``lookat`` | ``(frames, 3)``, m, world: the point in the middle of each frame |
    | ``distance`` | m |
    | ``azimuth``, ``elevation`` | of the view, degrees, as MuJoCo has them |
    | ``is_side`` | along the axis that a planar robot turns about |
    """

    lookat: np.ndarray
    distance: float
    azimuth: float
    elevation: float
    is_side: bool = False

    @cached_property
    def axes(self) -> np.ndarray:
        """Right, up and forward in the world, ``(3, 3)``, one a row."""
        a, e = radians(self.azimuth), radians(self.elevation)
        forward = np.array((cos(e) * cos(a), cos(e) * sin(a), sin(e)))
        right = np.array((sin(a), -cos(a), 0.0))
        return np.stack((right, np.cross(right, forward), forward))

    @property
    def half_height(self) -> float:
        """Half the height of the picture at the point looked at, m."""
        return self.distance * tan(radians(FIELD_OF_VIEW / 2.0))

    def project(self, points: np.ndarray, frame: int) -> np.ndarray:
        """Right and up from the middle of the picture, m, without perspective.

        Args:
            points: ``(*batch, 3)``, world.
            frame: its number.
        """
        return (points - self.lookat[frame]) @ self.axes[:2].T

    def depth(self, point: np.ndarray, frame: int) -> float:
        """How far behind the point looked at, m."""
        return float((point - self.lookat[frame]) @ self.axes[2])


def aim(poser: Poser, path: Tensor, step_size: float, aspect: float) -> Camera:
    """A camera that shows all of a motion: still, or following a floating base.

    Args:
        poser: of the robot.
        path: ``qpos (frames, nq)``.
        step_size: time between frames, s.
        aspect: width over height of the picture.
    """
    boxes, bases = [], []
    for qpos in path:
        data = poser.pose(qpos)
        centre = data.geom_xpos[poser.moving]
        reach = poser.model.geom_rbound[poser.moving, None]
        boxes.append(((centre - reach).min(0), (centre + reach).max(0)))
        bases.append(data.xpos[poser.scene.base.body].copy())
    lows, highs = (np.array(ends) for ends in zip(*boxes, strict=True))
    if poser.scene.base.is_floating:
        lookat = _smooth(np.array(bases), min(1.0, step_size / SMOOTHING))
    else:
        lows[0], highs[0] = _with(poser.scene.fixed_base_pose[0], lows[0], highs[0])
        lookat = np.broadcast_to((lows.min(0) + highs.max(0)) / 2.0, lows.shape)
    azimuth, elevation, is_side = _view(poser.common_axis())
    camera = Camera(lookat, 1.0, azimuth, elevation, is_side)
    spread = np.maximum(abs(lows - lookat), abs(highs - lookat)).max(0)
    width, height, depth = abs(camera.axes) @ spread
    half = MARGIN * max(height, width / aspect)
    distance = half / tan(radians(FIELD_OF_VIEW / 2.0)) + (depth if is_side else 0.0)
    return replace(camera, distance=float(distance))


def _with(point: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """A box grown to hold a point, ``(2, 3)``."""
    return np.stack((np.minimum(low, point), np.maximum(high, point)))


def _view(axis: np.ndarray | None) -> tuple[float, float, bool]:
    """Azimuth and elevation, and whether they are along a planar robot's axis."""
    if axis is None or 0.1 < abs(axis[2]) < 0.9:
        return (*OBLIQUE, False)
    if abs(axis[2]) >= 0.9:
        return (*ABOVE, False)
    return _along(axis), SIDE, True


def _along(axis: np.ndarray) -> float:
    """Azimuth of the view along a horizontal axis, +x to the right where it can be."""
    angle = degrees(atan2(axis[1], axis[0])) % 180.0
    return angle if angle > 0.0 else 180.0


def _smooth(path: np.ndarray, share: float) -> np.ndarray:
    """First-order low-pass, forwards and back, so that it does not lag."""
    for _ in range(2):
        path = path[::-1].copy()
        for i in range(1, len(path)):
            path[i] = path[i - 1] + share * (path[i] - path[i - 1])
    return path
