"""Three tasks of the Ant: run, spin, spin at 5 rad/s. Paper, appendix B."""

import torch
from torch import Tensor

from torchrl_nerd.geometry.constants import constant
from torchrl_nerd.geometry.rotations import random_tilt, rotate
from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.robots.ant.scene import STANDING_POSE, ant
from torchrl_nerd.tasks.floating import (
    WalkingTask,
    angular_velocity,
    heading,
    symmetric,
    uprightness,
)
from torchrl_nerd.tasks.task import State

START = (0.0, 0.0, 1.0)  # m, of the torso
START_SPREAD = (0.2, 0.2, 0.1)  # m
START_TILT = torch.pi / 6  # rad
MIN_HEIGHT = 0.3  # m
SPIN_TARGET = 5.0  # rad/s


class Ant(WalkingTask):
    """What the three share: torques, starts, the end.

    Ends below 0.3 m. The reference code starts the first joint at rest by a slip of its
    index and drops the last observed number (p_heading); here as in the paper.
    """

    build_scene = staticmethod(ant)
    horizon = 500
    num_uniforms = 29
    observation_size = 29

    def initial_state(self, u: Tensor) -> dict[str, Tensor]:
        """Above the ground, tilted up to 30 degrees, near the standing pose.

        Joints within 0.2 rad of it; velocities within 0.1 m/s and 0.25 rad/s, those of the
        base in its own axes.
        """
        where, turn, linear, angular, pose, rates = u.split([3, 4, 3, 3, 8, 8], -1)
        quat = random_tilt(turn, START_TILT)
        position = constant(u, START) + symmetric(where, constant(u, START_SPREAD))
        pose = constant(u, STANDING_POSE) + symmetric(pose, 0.2)
        velocity = rotate(quat, symmetric(linear, 0.1))
        rates = symmetric(torch.cat((angular, rates), -1), 0.25)  # (*batch, 3 + 8)
        return {
            QPOS: torch.cat((position, quat, pose), -1),  # (*batch, 3 + 4 + 8)
            QVEL: torch.cat((velocity, rates), -1),
        }

    def terminated(self, next_state: State) -> Tensor:
        """The torso is too low, bool ``(*batch,)``."""
        return next_state[QPOS][..., 2] < MIN_HEIGHT


class AntRun(Ant):
    """Reward v_x + 0.1 p_up + p_heading."""

    def reward(self, state: State, action: Tensor, next_state: State) -> Tensor:
        """Of the state that the step led to, ``(*batch,)``."""
        speed = next_state[QVEL][..., 0]
        return speed + 0.1 * uprightness(next_state) + heading(next_state)


class AntSpin(Ant):
    """Reward w_up + p_up: spin to the left as fast as it can."""

    def reward(self, state: State, action: Tensor, next_state: State) -> Tensor:
        """Of the state that the step led to, ``(*batch,)``."""
        return angular_velocity(next_state)[..., 2] + uprightness(next_state)


class AntSpinTrack(Ant):
    """Reward 5 exp(-(w_up - 5)^2 - 0.1 w_x^2 - 0.1 w_y^2) + 0.1 p_up."""

    def reward(self, state: State, action: Tensor, next_state: State) -> Tensor:
        """Of the state that the step led to, ``(*batch,)``."""
        x, y, up = angular_velocity(next_state).unbind(-1)
        cost = (up - SPIN_TARGET) ** 2 + 0.1 * x**2 + 0.1 * y**2
        return 5.0 * torch.exp(-cost) + 0.1 * uprightness(next_state)
