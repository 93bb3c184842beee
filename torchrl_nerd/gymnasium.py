"""Every task as a `gymnasium.Env` or a `gymnasium.VectorEnv`; importing registers them.

    import gymnasium, torchrl_nerd.gymnasium
    gymnasium.make("TorchrlNerd/AntRun-v0", dynamics="mujoco")
    gymnasium.make_vec("TorchrlNerd/AntRun-v0", num_envs=512)
    gymnasium.make("TorchrlNerd/Task-v0", task="dm_control/cheetah-run", dynamics="mujoco")

Or without the import: ``gymnasium.make("torchrl_nerd.gymnasium:TorchrlNerd/AntRun-v0")``.
"""

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from tensordict import TensorDict
from torch import Tensor

from torchrl_nerd.envs.base import SceneEnv
from torchrl_nerd.envs.make import make_env
from torchrl_nerd.keys import ACTION, OBSERVATION
from torchrl_nerd.robots import TASKS
from torchrl_nerd.tasks import Task

Info = dict[str, Any]


class GymnasiumVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """All envs of one batched env: one call of the dynamics steps them all.

    Observations ``(num_envs, D)`` and actions ``(num_envs, A)`` in [-1, 1] are float32. An
    env that has ended begins its next episode at the next step, whatever its action then
    is, with a reward of zero: Gymnasium's mode ``NEXT_STEP``.

    Args:
        task: id of a task, or a task.
        dynamics: as for `make_env`.
        num_envs: how many envs.
        seed: of the resets, until `reset` is given another; None for a fresh one.
        device: where the env computes.
    """

    metadata: Info = {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}

    def __init__(
        self,
        task: str | Task,
        dynamics: str | Path = "nerd",
        num_envs: int = 1,
        seed: int | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        self.env: SceneEnv = make_env(task, dynamics, num_envs, seed, device)
        self.num_envs = num_envs
        width, size = (
            self.env.task.observation_size,
            self.env.task.controller.num_actions,
        )
        self.single_observation_space = Box(-np.inf, np.inf, (width,), np.float32)
        self.single_action_space = Box(-1.0, 1.0, (size,), np.float32)
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
        env, begins = self.env, self._is_over  # (num_envs,): whose action is ignored
        given = torch.as_tensor(np.asarray(actions), dtype=torch.float32).to(env.device)
        after = env.step(TensorDict({ACTION: given}, env.batch_size))["next"]
        observation, reward = (
            _numpy(after[OBSERVATION]),
            _numpy(after["reward"].double()),
        )
        terminated, truncated = _numpy(after["terminated"]), _numpy(after["truncated"])
        if begins.any():
            rows = torch.from_numpy(begins)[:, None].to(env.device)
            fresh = env.reset(TensorDict({"_reset": rows}, env.batch_size))
            observation[begins] = _numpy(fresh[OBSERVATION])[begins]
            for column in (reward, terminated, truncated):  # (num_envs, 1) each
                column[begins] = 0
        reward, terminated, truncated = reward[:, 0], terminated[:, 0], truncated[:, 0]
        self._is_over = terminated | truncated
        return observation, reward, terminated, truncated, {}


class GymnasiumEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """One env: observation ``(D,)``, action ``(A,)`` in [-1, 1], both float32.

    Its arguments are those of `GymnasiumVectorEnv`.
    """

    metadata: Info = {"render_modes": []}

    def __init__(
        self,
        task: str | Task,
        dynamics: str | Path = "nerd",
        seed: int | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        self.vector = GymnasiumVectorEnv(task, dynamics, 1, seed, device)
        self.observation_space = self.vector.single_observation_space
        self.action_space = self.vector.single_action_space

    def reset(
        self, *, seed: int | None = None, options: Info | None = None
    ) -> tuple[np.ndarray, Info]:
        """Begin the next episode, or with a seed the first of its stream."""
        super().reset(seed=seed)
        observation, info = self.vector.reset(seed=seed)
        return observation[0], info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, Info]:
        """Observation, reward, terminated, truncated, and an empty info."""
        *results, info = self.vector.step(np.asarray(action)[None])
        observation, reward, terminated, truncated = (x[0] for x in results)
        return observation, float(reward), bool(terminated), bool(truncated), info


def _numpy(x: Tensor) -> np.ndarray:
    return x.cpu().numpy().copy()


def gymnasium_id(task: str) -> str:
    """Gymnasium's id of a registered task: ``TorchrlNerd/AntSpinTrack-v0``."""
    words = task.replace("/", "_").split("_")
    return f"TorchrlNerd/{''.join(word.capitalize() for word in words)}-v0"


def _register(env_id: str, **kwargs: str) -> None:
    gymnasium.register(
        env_id,
        entry_point=f"{__name__}:GymnasiumEnv",
        vector_entry_point=f"{__name__}:GymnasiumVectorEnv",
        kwargs=kwargs,
    )


_register("TorchrlNerd/Task-v0")  # any task, by its id as the argument ``task``
for _task in TASKS:
    _register(gymnasium_id(_task), task=_task)
