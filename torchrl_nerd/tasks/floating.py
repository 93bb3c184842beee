"""What tasks share: uniform draws, and what is seen of a robot with a floating base.

Joint positions come after the base's seven numbers, joint velocities after its six. The
reference code's axes are y up; here z is up, x forward and y to the left (its -z).
"""

import torch
from torch import Tensor

from torchrl_nerd.geometry.constants import constant
from torchrl_nerd.geometry.rotations import rotate
from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.tasks.task import State, Task


def symmetric(u: Tensor, half: Tensor | float) -> Tensor:
    """Numbers in [-half, half) from uniform ones in [0, 1), ``(*batch, n)``."""
    return (2.0 * u - 1.0) * half


def between(u: Tensor, low: tuple[float, ...], high: tuple[float, ...]) -> Tensor:
    """Numbers in [low, high) from uniform ones in [0, 1), ``(*batch, n)``."""
    a, b = constant(u, low), constant(u, high)
    return a + (b - a) * u


def angular_velocity(state: State) -> Tensor:
    """Of the base, rad/s, world axes, ``(*batch, 3)``."""
    return rotate(state[QPOS][..., 3:7], state[QVEL][..., 3:6])


def uprightness(state: State) -> Tensor:
    """World z of the base's z axis, p_up, ``(*batch,)``: 1 upright, -1 on its back."""
    _, x, y, _ = state[QPOS][..., 3:7].unbind(-1)
    return 1.0 - 2.0 * (x * x + y * y)


def heading(state: State) -> Tensor:
    """World x of the base's x axis, p_heading, ``(*batch,)``."""
    _, _, y, z = state[QPOS][..., 3:7].unbind(-1)
    return 1.0 - 2.0 * (y * y + z * z)


class WalkingTask(Task):
    """A task with the paper's observation of a walking robot."""

    def observation(self, state: State) -> Tensor:
        """Of a robot with n joints, ``(*batch, 13 + 2 n)``.

        Height (m); orientation (wxyz; the paper's is xyzw); linear velocity of the base's
        origin and angular velocity, both in world axes; joint positions and velocities;
        p_up, p_heading. Neither horizontal position nor time.
        """
        qpos, qvel = state[QPOS], state[QVEL]
        projections = torch.stack((uprightness(state), heading(state)), -1)
        parts = (qpos[..., 2:7], qvel[..., :3], angular_velocity(state))
        return torch.cat((*parts, qpos[..., 7:], qvel[..., 6:], projections), -1)
