"""No goal: the double pendulum swings and hits the ground, to measure dynamics."""

import torch
from torch import Tensor

from torchrl_nerd.geometry.constants import constant
from torchrl_nerd.geometry.rotations import wrap_angle
from torchrl_nerd.keys import QPOS, QVEL, TERRAIN
from torchrl_nerd.robots.double_pendulum.scene import (
    GROUNDS,
    double_pendulum,
    evaluation_ground,
)
from torchrl_nerd.tasks.task import State, Task

MAX_START_SPEED = 2.0  # rad/s


class DoublePendulumPassive(Task):
    """Zero reward, never terminated; the protocol of the paper's appendix C.2.

    Every env has one of the seven evaluation grounds, drawn at each reset, or the one that
    ``ground`` names.

    Args:
        ground: 0 (out of reach) to 6; None draws one per env.
    """

    build_scene = staticmethod(double_pendulum)
    horizon = 100
    num_uniforms = 5
    observation_size = 6
    parameters = {TERRAIN: 4}

    def __init__(self, ground: int | None = None) -> None:
        numbers = range(len(GROUNDS)) if ground is None else [ground]
        self.planes = [evaluation_ground(number).tolist() for number in numbers]

    def initial_state(self, u: Tensor) -> dict[str, Tensor]:
        """Joint 1 within pi; joint 2 such that the second link points up; within 2 rad/s.

        ``qpos`` and ``qvel (*batch, 2)``, rad and rad/s; ``terrain (*batch, 4)``: the
        plane's unit normal and its offset, m.
        """
        first = torch.pi * (2.0 * u[..., 0] - 1.0)
        second = wrap_angle(torch.pi * u[..., 1] - first)
        speed = MAX_START_SPEED * (2.0 * u[..., 2:4] - 1.0)
        number = (u[..., 4] * len(self.planes)).long().clamp_max(len(self.planes) - 1)
        return {
            QPOS: torch.stack((first, second), -1),
            QVEL: speed,
            TERRAIN: constant(u, self.planes)[number],
        }

    def observation(self, state: State) -> Tensor:
        """Sines, cosines and velocities (rad/s) of both joints, ``(*batch, 6)``."""
        return torch.cat((state[QPOS].sin(), state[QPOS].cos(), state[QVEL]), -1)
