"""Any of our envs as a `dm_env.Environment`, for agents written for DeepMind's suites."""

from pathlib import Path

import dm_env
import numpy as np
import torch
from dm_env import specs
from tensordict import TensorDict, TensorDictBase

from torchrl_nerd.envs.base import SceneEnv
from torchrl_nerd.envs.make import make_env
from torchrl_nerd.keys import ACTION, OBSERVATION
from torchrl_nerd.tasks import Task


class DmEnvironment(dm_env.Environment):
    """One env of a `SceneEnv`.

    The observation is one array ``(D,)``, float32; an action is ``(A,)`` in [-1, 1]. An
    episode that failed ends with discount 0, one that ran out of time with discount 1.

    Args:
        task: id of a task, or a task.
        dynamics: as for `make_env`.
        seed: of the resets.
        device: where the env computes.

    Examples:
        >>> env = DmEnvironment("cartpole/swingup")
        >>> env.reset().observation.shape, env.step(np.zeros(1)).discount
        ((4,), 1.0)
    """

    def __init__(
        self,
        task: str | Task,
        dynamics: str | Path = "nerd",
        seed: int = 0,
        device: torch.device | str = "cpu",
    ) -> None:
        self.env: SceneEnv = make_env(task, dynamics, 1, seed, device)
        self._is_over = True

    def reset(self) -> dm_env.TimeStep:
        """Begin the next episode."""
        self._is_over = False
        return dm_env.restart(self._observe(self.env.reset()))

    def step(self, action: np.ndarray) -> dm_env.TimeStep:
        """Act, or begin an episode where none is under way.

        Raises:
            ValueError: an action of another shape.
        """
        if self._is_over:
            return self.reset()
        given = torch.as_tensor(np.asarray(action), dtype=torch.float32)
        row = {ACTION: given.to(self.env.device)[None]}
        after = self.env.step(TensorDict(row, self.env.batch_size))["next"]
        observation, reward = self._observe(after), float(after["reward"])
        self._is_over = bool(after["done"])
        if after["terminated"]:
            return dm_env.termination(reward, observation)
        if after["truncated"]:
            return dm_env.truncation(reward, observation)
        return dm_env.transition(reward, observation)

    def observation_spec(self) -> specs.Array:  # pyright: ignore
        """One array, float32."""
        size = self.env.task.observation_size
        return specs.Array((size,), np.float32, OBSERVATION)

    def action_spec(self) -> specs.BoundedArray:  # pyright: ignore
        """One array in [-1, 1], float32."""
        size = self.env.task.controller.num_actions
        return specs.BoundedArray((size,), np.float32, -1.0, 1.0, ACTION)

    def _observe(self, state: TensorDictBase) -> np.ndarray:
        return np.array(state[OBSERVATION][0].cpu(), copy=True)
