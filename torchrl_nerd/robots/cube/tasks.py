"""No goal: a cube is tossed, to measure dynamics. Paper, appendix C.4."""

import torch
from torch import Tensor

from torchrl_nerd.geometry.constants import constant
from torchrl_nerd.geometry.rotations import random_tilt, rotate
from torchrl_nerd.keys import QPOS, QVEL, TERRAIN
from torchrl_nerd.robots.cube.scene import (
    CLEARANCE,
    START,
    UP,
    cube,
    cube_reach,
    cube_real,
    cube_slope,
    slope_beneath,
)
from torchrl_nerd.tasks.floating import angular_velocity, between
from torchrl_nerd.tasks.task import State, Task


class CubeToss(Task):
    """Zero reward, never terminated, nothing to act on: the action has no numbers.

    Observation: height (m), orientation (wxyz), linear velocity of the centre and angular
    velocity, both in world axes.
    """

    build_scene = staticmethod(cube)
    horizon = 74  # 0.5 s
    num_uniforms = 13
    observation_size = 11

    def initial_state(self, u: Tensor) -> dict[str, Tensor]:
        """Tosses of the training ranges.

        The height is drawn from what is clear of the ground at that orientation; the
        reference draws both again until they are.
        """
        where, turn, linear, angular = u.split([3, 4, 3, 3], -1)
        quat = random_tilt(turn, START.tilt)
        reach = cube_reach(quat, constant(quat, UP))
        low = constant(u, START.low).expand_as(where).clone()
        low[..., 2] = low[..., 2].maximum(reach + CLEARANCE)
        position = low + (constant(u, START.high) - low) * where
        velocity = between(linear, START.linear_low, START.linear_high)
        spin = between(angular, START.angular_low, START.angular_high)
        return {
            QPOS: torch.cat((position, quat), -1),
            QVEL: torch.cat((rotate(quat, velocity), spin), -1),
        }

    def observation(self, state: State) -> Tensor:
        """Height, orientation, velocities."""
        parts = (state[QPOS][..., 2:], state[QVEL][..., :3], angular_velocity(state))
        return torch.cat(parts, -1)


class RealCubeToss(CubeToss):
    """The same with the real cube's mass."""

    build_scene = staticmethod(cube_real)


class SlopeToss(CubeToss):
    """The same over a plane of its own in every env, up to 20 degrees steep."""

    build_scene = staticmethod(cube_slope)
    num_uniforms = CubeToss.num_uniforms + 2
    parameters = {TERRAIN: 4}

    def initial_state(self, u: Tensor) -> dict[str, Tensor]:
        """Tosses of the training ranges, as far above the slope as above level ground.

        ``terrain (*batch, 4)`` beside them: the plane's unit normal and its offset, m.
        """
        toss, slope = u.split([CubeToss.num_uniforms, 2], -1)
        state = super().initial_state(toss)
        return state | {TERRAIN: slope_beneath(state[QPOS], slope)}
