"""The state at the end of a window of poses: what a log without velocities starts from."""

from dataclasses import replace

import torch
from torch import Generator, Tensor, nn

from torchrl_nerd.data.recorded import CLEAR, Recording
from torchrl_nerd.geometry.manifold import differentiate_pos, integrate_pos
from torchrl_nerd.geometry.rotations import (
    quat_exp,
    quat_multiply,
    rotate,
    rotate_inverse,
)
from torchrl_nerd.scenes.scene import Scene

WIDTH = 64
REACH = (0.1, 1.0)  # m/s and rad/s: size of a correction of velocities
ARM = 0.1  # m: noise turns the cube as much as it moves a point so far out
SHIFT = 1e-3  # m and rad: size of a correction of the pose


class PoseEncoder(nn.Module):
    """Velocities of a free body, and a smoother pose, from its last ``poses`` poses.

    A weighted mean of the velocities between the last pose and each before it, plus what a
    small network adds. It sees them in the base frame, with gravity. At first the mean is
    the slope of the line of least squares through the window, and nothing is added. That
    slope is of the window's middle. Where all of the window is airborne, the fall since
    then is added.

    Args:
        scene: a single free body.
        poses: in the window, at least 2.
        every: control steps between two poses.

    Raises:
        ValueError: another robot, or a window that holds no velocity.
    """

    def __init__(self, scene: Scene, poses: int = 4, every: int = 1) -> None:
        super().__init__()
        if scene.model.nv != 6 or not scene.base.is_floating:
            raise ValueError(f"expected a single free body, got scene '{scene.name}'")
        if poses < 2 or every < 1:
            raise ValueError(
                f"expected at least 2 poses and every 1, got {poses} and {every}"
            )
        self.scene, self.layout = scene, scene.layout
        self.poses, self.every = poses, every
        lag = torch.arange(poses - 1, 0, -1, dtype=torch.float64)
        self.lags = scene.control_step * every * lag  # s before the last pose
        self.weights = nn.Parameter(_slope_weights(lag))
        self.network = nn.Sequential(
            nn.Linear(6 * (poses - 1) + 4, WIDTH),
            nn.SiLU(),
            nn.Linear(WIDTH, WIDTH),
            nn.SiLU(),
            nn.Linear(WIDTH, 12),
        )
        for weight in self.network[-1].parameters():
            nn.init.zeros_(weight)

    @property
    def span(self) -> int:
        """Control steps from the window's first pose to its last."""
        return (self.poses - 1) * self.every

    def forward(self, window: Tensor) -> tuple[Tensor, Tensor]:
        """``(rows, poses, 7)`` to the state at the last pose, ``(rows, 7), (rows, 6)``."""
        last = window[:, -1]
        quat = last[:, 3:7]
        before = window[:, :-1]
        here = last[:, None].expand_as(before)
        back = differentiate_pos(self.layout, here, before)
        speeds = (
            -back / self.lags.to(back)[:, None]
        )  # mean velocities up to the last pose
        linear = rotate_inverse(quat[:, None], speeds[..., :3])
        speeds = torch.cat((linear, speeds[..., 3:]), -1)
        down = torch.zeros_like(last[:, :3])
        down[:, 2] = -1.0
        seen = torch.cat(
            (speeds.flatten(1), rotate_inverse(quat, down), last[:, 2:3]), -1
        )
        change = self.network(seen.float()).double()
        size = change.new_tensor(REACH).repeat_interleave(3)
        velocity = self.weights @ speeds + size * change[:, :6]
        is_airborne = self.scene.clearances(window).amin((-2, -1)) > CLEAR
        gravity = torch.as_tensor(self.scene.model.opt.gravity).to(last)
        fall = 0.5 * self.span * self.scene.control_step * gravity
        linear = rotate(quat, velocity[:, :3]) + is_airborne[:, None] * fall
        shift = SHIFT * change[:, 6:]
        return (
            integrate_pos(self.layout, last, shift),
            torch.cat((linear, velocity[:, 3:]), -1),
        )


def _slope_weights(lag: Tensor) -> Tensor:
    """Weights of the mean velocities that give the least squares' slope, ``(poses - 1,)``.

    With the last pose at time 0 and p(t) - p(0) = -lag * speed, the slope through all
    points is sum (t - mean t) p / sum (t - mean t)^2.
    """
    time = torch.cat((-lag, lag.new_zeros(1)))
    centred = time - time.mean()
    return (centred[:-1] * time[:-1]) / centred.square().sum()


def with_noise(recording: Recording, noise: float, seed: int = 0) -> Recording:
    """Poses of a worse camera, without velocities: the same for the same seed.

    Args:
        recording: of a free body.
        noise: m, of every position.
        seed: of the noise.
    """
    qpos, generator = recording.qpos, Generator().manual_seed(seed)
    drawn = noise * torch.randn(2, len(qpos), 3, generator=generator).to(qpos)
    turned = quat_multiply(qpos[:, 3:7], quat_exp(drawn[1] / ARM))
    blurred = torch.cat((qpos[:, :3] + drawn[0], turned), -1)
    # a velocity that is used after all would reach the results
    return replace(
        recording, qpos=blurred, qvel=torch.full_like(recording.qvel, torch.nan)
    )
