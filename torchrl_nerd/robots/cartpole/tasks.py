"""Swing the pole up and keep it there, without running off the rail."""

import torch
from torch import Tensor

from torchrl_nerd.geometry.constants import constant
from torchrl_nerd.geometry.rotations import wrap_angle
from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.robots.cartpole.scene import cartpole
from torchrl_nerd.tasks.task import State, Task

START = (1.0, torch.pi, 1.0, 1.0)  # half ranges of x, theta, their velocities
MAX_POSITION = 4.0  # m
MAX_SPEED = 10.0  # m/s and rad/s


class CartpoleSwingup(Task):
    """Reward 5 - theta^2 - 0.05 x^2 - 0.1 theta'^2 - 0.1 x'^2, paper, appendix B.

    Observation: x, theta in [-pi, pi), x', theta'. Ends at |x| > 4 m, |x'| > 10 m/s or
    |theta'| > 10 rad/s.
    """

    build_scene = staticmethod(cartpole)
    horizon = 300
    num_uniforms = 4
    observation_size = 4

    def initial_state(self, u: Tensor) -> dict[str, Tensor]:
        """``qpos (*batch, 2)`` within 1 m and pi rad, ``qvel`` within 1 m/s and 1 rad/s."""
        start = (2.0 * u - 1.0) * constant(u, START)
        return {QPOS: start[..., :2], QVEL: start[..., 2:]}

    def observation(self, state: State) -> Tensor:
        """x, theta wrapped, x', theta': ``(*batch, 4)``, m, rad, m/s, rad/s."""
        position, angle = state[QPOS].unbind(-1)
        where = torch.stack((position, wrap_angle(angle)), -1)
        return torch.cat((where, state[QVEL]), -1)

    def reward(self, state: State, action: Tensor, next_state: State) -> Tensor:
        """Of the state that the step led to, ``(*batch,)``."""
        position, angle = next_state[QPOS].unbind(-1)
        speed, spin = next_state[QVEL].unbind(-1)
        cost = wrap_angle(angle) ** 2 + 0.05 * position**2
        return 5.0 - cost - 0.1 * spin**2 - 0.1 * speed**2

    def terminated(self, next_state: State) -> Tensor:
        """Off the rail or too fast, bool ``(*batch,)``."""
        position = next_state[QPOS][..., 0].abs()
        speed = next_state[QVEL].abs().amax(-1)
        return (position > MAX_POSITION) | (speed > MAX_SPEED)
