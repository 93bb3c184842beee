"""What tasks of robots with a floating base share: tilted starts, and what is seen.

Joint positions come after the base's seven numbers, joint velocities after its six. The
reference code's axes are y up; here z is up, x forward and y to the left (its -z).
"""

import torch
from torch import Tensor

from torchrl_nerd.geometry.rotations import random_tilt, rotate
from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.tasks.task import State, Task


def symmetric(u: Tensor, half: Tensor | float) -> Tensor:
    """Numbers in [-half, half) from uniform ones in [0, 1), ``(*batch, n)``."""
    return (2.0 * u - 1.0) * half


def tilted_start(
    u: Tensor, center: Tensor, spread: tuple[float, float, float], tilt: float
) -> dict[str, Tensor]:
    """A floating base near ``center``, tilted and slowly moving, its joints too.

    Position within ``spread`` (m), joints within 0.2 rad, velocities within 0.1 m/s and
    0.25 rad/s, both of the base in its own axes.

    Args:
        u: ``(*batch, 13 + 2 n)`` uniform numbers, for n joints.
        center: ``(3 + n,)`` position of the base (m) and of the joints (rad).
        spread: half ranges of the base's position, m, world.
        tilt: largest angle of `random_tilt`, rad.
    """
    joints = len(center) - 3
    sizes = [3, 4, 3, 3, joints, joints]
    where, turn, linear, angular, pose, rates = u.split(sizes, -1)
    quat = random_tilt(turn, tilt)
    position = center[:3] + symmetric(where, u.new_tensor(spread))
    pose = center[3:] + symmetric(pose, 0.2)
    velocity = rotate(quat, symmetric(linear, 0.1))
    rates = torch.cat((symmetric(angular, 0.25), symmetric(rates, 0.25)), -1)
    return {
        QPOS: torch.cat((position, quat, pose), -1),
        QVEL: torch.cat((velocity, rates), -1),
    }


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
