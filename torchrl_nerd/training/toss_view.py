"""What a fine-tuner may see of recorded tosses: whole states, or poses alone."""

from dataclasses import replace

import torch
from tensordict import TensorDict
from torch import Generator, Tensor

from torchrl_nerd.configs import FinetuneConfig
from torchrl_nerd.data.cube_tosses import Tosses
from torchrl_nerd.dynamics import NeRDDynamics
from torchrl_nerd.evaluation.rollout_error import open_loop
from torchrl_nerd.evaluation.toss_error import STATES, path_errors, toss_errors
from torchrl_nerd.geometry.rotations import quat_exp, quat_multiply
from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.modules.pose_encoder import PoseEncoder
from torchrl_nerd.scenes import Scene

ARM = 0.1  # m: a camera's noise turns the cube as much as it moves a point so far out


class TossView:
    """Recorded tosses as a fine-tuner sees them.

    Where poses alone are seen, an encoder finds the state that a rollout starts from in the
    window of poses before it, and no recorded velocity is used.

    Args:
        scene: of the cube.
        tosses: recorded.
        config: what of them is seen.
        device: of the encoder; the tosses stay where they are.
    """

    def __init__(
        self,
        scene: Scene,
        tosses: Tosses,
        config: FinetuneConfig,
        device: torch.device | str = "cpu",
    ) -> None:
        self.encoder: PoseEncoder | None = None
        self.every, self.seen = config.every, tosses
        if config.observe == "poses":
            encoder = PoseEncoder(scene, config.poses, config.every)
            self.encoder = encoder.to(device)
            self.seen = replace(tosses, qpos=noisy_poses(tosses.qpos, config))

    @property
    def before(self) -> int:
        """Control steps that the encoder sees before a rollout."""
        return self.encoder.span if self.encoder else 0

    def starts(self, states: int, numbers: Tensor) -> Tensor:
        """Rows of the first of what is seen of every ``states`` states, ``(windows,)``."""
        return self.seen.starts(self.before + states, numbers)

    def windows(self, rows: Tensor, states: int) -> TensorDict:
        """Those states, the encoder's poses before them, ``[windows, before + states]``."""
        return self.seen.windows(rows, self.before + states)

    def observe(self, window: TensorDict) -> tuple[Tensor, Tensor, Tensor]:
        """Where a rollout starts, and what it is to meet.

        Args:
            window: as of `windows`.

        Returns:
            ``qpos`` and ``qvel`` of the start, and the poses after it
            ``(windows, states - 1, 7)``.
        """
        qpos = window[QPOS]
        after = qpos[:, self.before + 1 :]
        if self.encoder is None:
            return qpos[:, 0], window[QVEL][:, 0], after
        return *self.encoder(qpos[:, : self.before + 1 : self.every]), after

    @torch.no_grad()
    def errors(
        self, model: NeRD, rows: Tensor, truth: Tosses | None = None
    ) -> tuple[Tensor, Tensor]:
        """Errors of sub-trajectories of 80 states; see `toss_errors`.

        Args:
            model: whose they are.
            rows: as of `starts`.
            truth: poses to measure against; those that are seen where None.
        """
        dynamics, truth = NeRDDynamics(model), truth or self.seen
        if self.encoder is None:
            return toss_errors(dynamics, truth, rows)
        qpos, qvel, _ = self.observe(self.windows(rows, STATES).to(model.device))
        start = TensorDict({QPOS: qpos, QVEL: qvel}, [len(rows)]).cpu()
        measured = truth.windows(rows + self.before, STATES)[QPOS][:, 1:]
        return path_errors(open_loop(dynamics, start, STATES - 1), measured)


def noisy_poses(qpos: Tensor, config: FinetuneConfig) -> Tensor:
    """Poses ``(N, 7)`` of a worse camera: the same for the same seed."""
    generator = Generator().manual_seed(config.seed)
    shape = (2, len(qpos), 3)
    noise = config.pose_noise * torch.randn(shape, generator=generator).to(qpos)
    turned = quat_multiply(qpos[:, 3:7], quat_exp(noise[1] / ARM))
    return torch.cat((qpos[:, :3] + noise[0], turned), -1)
