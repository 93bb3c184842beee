"""Any of our envs as a `dm_env.Environment`, for agents written for DeepMind's suites."""

from pathlib import Path

import dm_env
import numpy as np
import torch
from dm_env import specs
from tensordict import TensorDict

from torchrl_nerd.envs.actor import as_action
from torchrl_nerd.envs.base import SceneEnv
from torchrl_nerd.envs.make import make_env
from torchrl_nerd.keys import ACTION, OBSERVATION
from torchrl_nerd.scenes import Scene
from torchrl_nerd.tasks import Task


class DmEnvironment(dm_env.Environment):
    """One env of a `SceneEnv`.

    The observation is one array ``(D,)``, float32; an action is ``(A,)`` in [-1, 1]. An
    episode that failed ends with discount 0, one that ran out of time with discount 1.

    Arguments as those of `make_env`.

    Examples:
        >>> env = DmEnvironment("cartpole/swingup")
        >>> env.reset().observation.shape, env.step(np.zeros(1)).discount
        ((4,), 1.0)
    """

    def __init__(
        self,
        task: str | Path | Scene | Task,
        dynamics: str | Path = "nerd",
        seed: int | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        self.env: SceneEnv = make_env(task, dynamics, 1, seed, device)
        self._is_over = True

    def close(self) -> None:
        """Free what images were drawn with."""
        self.env.close()

    def reset(self) -> dm_env.TimeStep:
        """Begin the next episode."""
        self._is_over = False
        return dm_env.restart(self.env.reset()[OBSERVATION][0].cpu().numpy())

    def step(self, action: np.ndarray) -> dm_env.TimeStep:
        """Act, or begin an episode where none is; ValueError for another shape."""
        if self._is_over:
            return self.reset()
        given = {ACTION: as_action(action).to(self.env.device)[None]}  # (1, A)
        after = self.env.step(TensorDict(given, self.env.batch_size))["next"]
        self._is_over = bool(after["done"])
        make = dm_env.transition
        if self._is_over:
            make = dm_env.termination if after["terminated"] else dm_env.truncation
        return make(float(after["reward"]), after[OBSERVATION][0].cpu().numpy())

    def render(self, height: int = 240, width: int = 320) -> np.ndarray:
        """An image ``(height, width, 3)``, uint8; see `SceneEnv.render`."""
        return self.env.render(height=height, width=width)[0]

    def observation_spec(self) -> specs.Array:  # pyright: ignore
        """One array, float32."""
        size = self.env.task.observation_size
        return specs.Array((size,), np.float32, OBSERVATION)

    def action_spec(self) -> specs.BoundedArray:  # pyright: ignore
        """One array in [-1, 1], float32."""
        size = self.env.task.controller.num_actions
        return specs.BoundedArray((size,), np.float32, -1.0, 1.0, ACTION)
