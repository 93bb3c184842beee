"""The last observations, for policies that see no velocities in a single one."""

from typing import cast

import torch
from torch import Tensor
from torchrl.envs import CatFrames, TransformedEnv

from torchrl_nerd.envs.actor import Actor
from torchrl_nerd.envs.base import SceneEnv
from torchrl_nerd.keys import OBSERVATION
from torchrl_nerd.settings import expect_at_least


def memory_of(actor: Actor) -> int:
    """How many observations an actor wants to be shown: its ``memory``, or 1."""
    return getattr(actor, "memory", 1)


def remember(env: SceneEnv, memory: int) -> SceneEnv:
    """An env whose ``observation`` is its last ones side by side, the oldest first.

    The first one after a reset stands for those before it.

    Args:
        env: what to remember.
        memory: how many observations, the present one included; 1 gives ``env`` itself.

    Raises:
        ValueError: no observation at all.

    Examples:
        >>> from torchrl_nerd.envs import make_env
        >>> env = remember(make_env("franka/reach", num_envs=4), memory=3)
        >>> env.rollout(5)["observation"].shape  # 13 numbers each
        torch.Size([4, 5, 39])
    """
    expect_at_least(1, memory=memory)
    if memory == 1:
        return env
    stacked = TransformedEnv(env, CatFrames(memory, -1, [OBSERVATION]))
    return cast(SceneEnv, stacked)  # which hands every other attribute on


def recall(recent: Tensor | None, observation: Tensor, memory: int) -> Tensor:
    """What `remember` shows, for a loop without an env.

    Args:
        recent: what this function gave one action ago; None at the start.
        observation: ``(*batch, D)``.
        memory: how many observations.

    Returns:
        ``(*batch, memory * D)``.
    """
    if recent is None:
        return observation.tile(memory)
    return torch.cat((recent[..., observation.shape[-1] :], observation), -1)
