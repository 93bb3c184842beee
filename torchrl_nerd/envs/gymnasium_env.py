"""Any of our envs as a `gymnasium.Env`, or many envs at once as a `gymnasium.VectorEnv`.

`torchrl_nerd.gymnasium` registers both for every task.
"""

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_nerd.envs.base import SceneEnv
from torchrl_nerd.envs.make import make_env
from torchrl_nerd.keys import ACTION, OBSERVATION
from torchrl_nerd.tasks import Task

SEEDS = 2**31  # of envs that nobody has seeded

Info = dict[str, Any]


class GymnasiumEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """One env: observation ``(D,)``, action ``(A,)`` in [-1, 1], both float32.

    Args:
        task: id of a task, or a task.
        dynamics: as for `make_env`.
        seed: of the resets, until `reset` is given another; None for a fresh one.
        device: where the env computes.
    """

    metadata: dict[str, Any] = {"render_modes": []}

    def __init__(
        self,
        task: str | Task,
        dynamics: str | Path = "nerd",
        seed: int | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        seed = int(self.np_random.integers(SEEDS)) if seed is None else seed
        self.env: SceneEnv = make_env(task, dynamics, 1, seed, device)
        self.observation_space, self.action_space = _spaces(self.env)

    def reset(
        self, *, seed: int | None = None, options: Info | None = None
    ) -> tuple[np.ndarray, Info]:
        """Begin the next episode, or with a seed the first of its stream."""
        super().reset(seed=seed)
        if seed is not None:
            self.env.set_seed(seed)
        return _numpy(self.env.reset()[OBSERVATION])[0], {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, Info]:
        """Observation, reward, terminated, truncated, and an empty info."""
        after = _act(self.env, np.asarray(action)[None])
        observation, reward, terminated, truncated = (x[0] for x in _results(after))
        return observation, float(reward), bool(terminated), bool(truncated), {}


class GymnasiumVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """All envs of one batched env: one call of the dynamics steps them all.

    An env that has ended begins its next episode at the next step, whatever its action
    then is, with a reward of zero: Gymnasium's mode ``NEXT_STEP``.

    Args:
        task: id of a task, or a task.
        dynamics: as for `make_env`.
        num_envs: how many envs.
        seed: of the resets, until `reset` is given another; None for a fresh one.
        device: where the env computes.
    """

    metadata: dict[str, Any] = {
        "render_modes": [],
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        task: str | Task,
        dynamics: str | Path = "nerd",
        num_envs: int = 1,
        seed: int | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        seed = int(self.np_random.integers(SEEDS)) if seed is None else seed
        self.env: SceneEnv = make_env(task, dynamics, num_envs, seed, device)
        self.num_envs = num_envs
        self.single_observation_space, self.single_action_space = _spaces(self.env)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._is_over = np.zeros(num_envs, bool)

    def reset(
        self, *, seed: int | None = None, options: Info | None = None
    ) -> tuple[np.ndarray, Info]:
        """Begin an episode in each env; with a seed, the first of its envs' streams."""
        super().reset(seed=seed)
        if seed is not None:
            self.env.set_seed(seed)
        self._is_over = np.zeros(self.num_envs, bool)
        return _numpy(self.env.reset()[OBSERVATION]), {}

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Info]:
        """Observations, rewards, terminated, truncated of all envs; an empty info."""
        after, begins = _act(self.env, actions), self._is_over
        observation, reward, terminated, truncated = _results(after)
        if begins.any():
            rows = torch.from_numpy(begins)[:, None].to(self.env.device)
            fresh = self.env.reset(TensorDict({"_reset": rows}, self.env.batch_size))
            observation[begins] = _numpy(fresh[OBSERVATION])[begins]
            reward, terminated, truncated = (
                np.where(begins, np.zeros_like(x), x)
                for x in (reward, terminated, truncated)
            )
        self._is_over = terminated | truncated
        return observation, reward, terminated, truncated, {}


def _spaces(env: SceneEnv) -> tuple[Box, Box]:
    """Observation and action space of one env."""
    width, size = env.task.observation_size, env.task.controller.num_actions
    observation = Box(-np.inf, np.inf, (width,), np.float32)
    return observation, Box(-1.0, 1.0, (size,), np.float32)


def _act(env: SceneEnv, actions: np.ndarray) -> TensorDictBase:
    """What a step writes under ``next``."""
    given = torch.as_tensor(np.asarray(actions), dtype=torch.float32).to(env.device)
    return env.step(TensorDict({ACTION: given}, env.batch_size))["next"]


def _results(
    after: TensorDictBase,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Observation, reward (float64), terminated and truncated, one entry per env."""
    reward = _numpy(after["reward"].double())[:, 0]
    terminated, truncated = (
        _numpy(after[key])[:, 0] for key in ("terminated", "truncated")
    )
    return _numpy(after[OBSERVATION]), reward, terminated, truncated


def _numpy(x: Tensor) -> np.ndarray:
    return x.cpu().numpy().copy()
