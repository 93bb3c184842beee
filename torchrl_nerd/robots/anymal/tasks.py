"""ANYmal walks forward or sideways at 1 m/s. Paper, appendix B."""

from functools import cached_property
from typing import ClassVar

import torch
from torch import Tensor

from torchrl_nerd.geometry.constants import constant, take
from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.robots.anymal.scene import ACTION_SCALE, KD, KP, STANDING_POSE, anymal
from torchrl_nerd.scenes.controllers import PDController
from torchrl_nerd.tasks.floating import WalkingTask, angular_velocity, symmetric
from torchrl_nerd.tasks.task import State

START_HEIGHT = 0.7  # m
START_SPEED = 0.1  # rad/s
MIN_HEIGHT = 0.4  # m
MIN_CLEARANCE = 0.01  # m, of base and knees
TORQUE_COST = 0.002  # per N m


class Anymal(WalkingTask):
    """Reward exp(-|v - v*|^2) + 0.5 exp(-w_up^2) - (0.002 sum(torque))^2.

    v is the horizontal velocity of the base's origin, in world axes. The action moves
    spring targets by 0.5 rad about the standing pose. The torque is signed inside the
    sum, as the paper prints it; the reference code instead takes 2.5e-5 sum(torque^2)
    and clips rewards at zero.

    Ends where the base is below 0.4 m, or base or knees within 1 cm of the ground.
    """

    build_scene = staticmethod(anymal)
    horizon = 1000
    num_uniforms = 24
    observation_size = 37
    velocity: ClassVar[tuple[float, float]]
    """Wanted velocity, m/s, forward and to the left."""

    @property
    def controller(self) -> PDController:
        """Springs about the standing pose, torque without limit."""
        return PDController(
            qpos_addresses=tuple(range(7, 19)),
            dof_addresses=tuple(range(6, 18)),
            kp=(KP,) * 12,
            kd=(KD,) * 12,
            scale=(ACTION_SCALE,) * 12,
            default=STANDING_POSE,
        )

    def initial_state(self, u: Tensor) -> dict[str, Tensor]:
        """Upright at rest, 8 cm up; joints at 0.5 to 1.5 times the pose, +-0.1 rad/s."""
        pose = constant(u, STANDING_POSE) * (0.5 + u[..., :12])
        rates = symmetric(u[..., 12:], START_SPEED)
        base = constant(u, (0.0, 0.0, START_HEIGHT, 1.0, 0.0, 0.0, 0.0))
        batch = u.shape[:-1]
        return {
            QPOS: torch.cat((base.expand(*batch, 7), pose), -1),
            QVEL: torch.cat((torch.zeros_like(u[..., :6]), rates), -1),
        }

    def reward(self, state: State, action: Tensor, next_state: State) -> Tensor:
        """Of the state that the step led to, and of the torque on the way."""
        offset = next_state[QVEL][..., :2] - constant(next_state[QVEL], self.velocity)
        spin = angular_velocity(next_state)[..., 2]
        torque = self.controller(action, state[QPOS], state[QVEL]).sum(-1)
        tracking = torch.exp(-(offset**2).sum(-1)) + 0.5 * torch.exp(-(spin**2))
        return tracking - (TORQUE_COST * torque) ** 2

    def terminated(self, next_state: State) -> Tensor:
        """Too low, or base or knees at the ground."""
        qpos = next_state[QPOS]
        clearance = take(self.scene.clearances(qpos), self._upper_points).amin(-1)
        return (qpos[..., 2] < MIN_HEIGHT) | (clearance < MIN_CLEARANCE)

    @cached_property
    def _upper_points(self) -> list[int]:
        """Contact points of base and knees."""
        model, bodies = self.scene.model, self.scene.contacts.bodies
        names = [model.body(body).name for body in bodies]
        return [i for i, name in enumerate(names) if not name.endswith("SHANK")]


class AnymalForward(Anymal):
    """Wanted: 1 m/s along world x."""

    velocity = (1.0, 0.0)


class AnymalSideways(Anymal):
    """Wanted: 1 m/s to the right, along world -y (the reference's +z)."""

    velocity = (0.0, -1.0)
