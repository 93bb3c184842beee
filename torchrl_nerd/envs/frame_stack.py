"""The last observations, for policies that see no velocities in a single one."""

from typing import cast

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import CatFrames, TransformedEnv

from torchrl_nerd.envs.actor import Actor
from torchrl_nerd.envs.base import SceneEnv
from torchrl_nerd.keys import OBSERVATION
from torchrl_nerd.settings import expect_count


def frame_stack_of(actor: Actor) -> int:
    """How many observations an actor wants to be shown: its ``frame_stack``, or 1."""
    return getattr(actor, "frame_stack", 1)


def stack_frames(env: SceneEnv, frame_stack: int) -> SceneEnv:
    """An env whose ``observation`` is its last ones side by side, the oldest first.

    The first one after a reset stands for those before it. One frame is ``env`` itself.

    Raises:
        ValueError: no whole number of at least one frame.

    Examples:
        >>> from torchrl_nerd.envs import make_env
        >>> env = stack_frames(make_env("franka/reach", num_envs=4), frame_stack=3)
        >>> env.rollout(5)["observation"].shape  # 13 numbers each
        torch.Size([4, 5, 39])
    """
    expect_count(1, frame_stack=frame_stack)
    if frame_stack == 1:
        return env
    stacked = TransformedEnv(env, _Frames(frame_stack, -1, [OBSERVATION]))
    return cast(SceneEnv, stacked)  # which hands every other attribute on


class _Frames(CatFrames):
    """`CatFrames` that leave an env alone whose ``_step`` is False."""

    def _step(
        self, tensordict: TensorDictBase, next_tensordict: TensorDictBase
    ) -> TensorDictBase:
        moves = tensordict.get("_step", None)
        if moves is None:
            return super()._step(tensordict, next_tensordict)
        (frames,) = self.buffers()  # (num_envs, frame_stack * D)
        before = frames.clone()
        after = super()._step(tensordict, next_tensordict)
        kept = torch.where(moves.reshape(len(before), 1), frames, before)
        frames.copy_(kept)
        return after.set(OBSERVATION, kept)


def append_frame(
    recent: Tensor | None, observation: Tensor, frame_stack: int
) -> Tensor:
    """What `stack_frames` shows, ``(*batch, frame_stack * D)``, for a loop without an env.

    From an ``observation (*batch, D)`` and ``recent``, what this function gave one action
    ago; None at the start.
    """
    if recent is None:
        return observation.tile(frame_stack)
    return torch.cat((recent[..., observation.shape[-1] :], observation), -1)
