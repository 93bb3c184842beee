"""Axes of hinges and slides as points on their bodies, and the bodies that they move."""

from dataclasses import dataclass

import mujoco
import numpy as np

from torchrl_nerd.geometry.base import Base
from torchrl_nerd.geometry.manifold import HINGE, SLIDE


@dataclass(frozen=True, eq=False)
class JointAxes:
    """The joints of a robot whose bodies have at most one each, its free base aside.

    The anchor and the tip of the axis of every joint are points on its body, for
    `PointKinematics` to find beside others.

    | field | meaning |
    |---|---|
    | ``joints`` | ids of the hinges and slides, in the order of their dofs |
    | ``bodies`` | of those points: all anchors, then all tips |
    | ``positions`` | ``(2 J, 3)``, m, in the body's frame |
    | ``is_slide`` | ``(J,)``: 1 for a slide, 0 for a hinge |
    """

    model: mujoco.MjModel
    joints: list[int]
    bodies: list[int]
    positions: np.ndarray
    is_slide: np.ndarray

    @classmethod
    def of(cls, model: mujoco.MjModel, base: Base) -> "JointAxes":
        """Read them from a compiled model.

        Raises:
            ValueError: a ball joint, or several joints of one body.
        """
        joints = [j for j in range(model.njnt) if model.jnt_type[j] in (HINGE, SLIDE)]
        if len(joints) + base.is_floating < model.njnt or (model.body_jntnum > 1).any():
            raise ValueError(
                "expected hinges and slides, one to a body, for the equation of motion, "
                "got others"
            )
        bodies = [int(model.jnt_bodyid[j]) for j in joints]
        anchor, axis = model.jnt_pos[joints], model.jnt_axis[joints]
        positions = np.concatenate((anchor, anchor + axis))
        is_slide = (model.jnt_type[joints] == SLIDE).astype(np.float64)
        return cls(model, joints, bodies + bodies, positions, is_slide)

    def ancestry(self, bodies: list[int]) -> np.ndarray:
        """``(J, len(bodies))``: 1 where a body moves with a joint, else 0."""
        moved = self.bodies[: len(self.joints)]
        below = [[_is_below(self.model, body, top) for body in bodies] for top in moved]
        return np.array(below, dtype=np.float64).reshape(len(moved), len(bodies))


def _is_below(model: mujoco.MjModel, body: int, ancestor: int) -> bool:
    """Whether a body moves with another one."""
    while body and body != ancestor:
        body = int(model.body_parentid[body])
    return body == ancestor
