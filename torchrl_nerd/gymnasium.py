"""Every task as a `gymnasium.Env` or a `gymnasium.VectorEnv`; importing registers them.

    import gymnasium, torchrl_nerd.gymnasium
    gymnasium.make("TorchrlNerd/AntRun-v0", dynamics="mujoco")
    gymnasium.make_vec("TorchrlNerd/AntRun-v0", num_envs=512, render_mode="rgb_array")
    gymnasium.make("TorchrlNerd/Task-v0", task="dm_control/cheetah-run", dynamics="mujoco")

Or without the import: ``gymnasium.make("torchrl_nerd.gymnasium:TorchrlNerd/AntRun-v0")``.
"""

import copy
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

from torchrl_nerd.envs.actor import as_action
from torchrl_nerd.envs.base import SceneEnv
from torchrl_nerd.envs.make import make_env
from torchrl_nerd.keys import ACTION, OBSERVATION
from torchrl_nerd.robots import TASKS, make_task
from torchrl_nerd.robots.registry import for_each_task
from torchrl_nerd.scenes import Scene
from torchrl_nerd.settings import expect_count
from torchrl_nerd.tasks import Task

Info = dict[str, Any]


class GymnasiumVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """All envs of one batched env: one call of the dynamics steps them all.

    Observations ``(num_envs, D)`` and actions ``(num_envs, A)`` in [-1, 1] are float32. An
    env that has ended begins its next episode at the next step, whatever its action then
    is, with a reward of zero: Gymnasium's mode ``NEXT_STEP``.

    Args:
        task, dynamics, num_envs, device, camera_id: see `make_env`.
        seed: of the resets, until `reset` is given another; drawn where none is given.
        render_mode: ``"rgb_array"`` for images by `render`, or None.
        max_episode_steps: steps until ``truncated``, where the task's horizon is longer.
        height: of an image, pixels.
        width: of an image, pixels.

    Raises:
        ValueError: what `make_env` refuses, an unknown render mode, or no steps.
    """

    metadata: Info = {
        "render_modes": ["rgb_array"],
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        task: str | Path | Scene | Task,
        dynamics: str | Path = "nerd",
        num_envs: int = 1,
        seed: int | None = None,
        device: torch.device | str = "cpu",
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        height: int = 240,
        width: int = 320,
        camera_id: int | str | None = None,
    ) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(
                f"unknown render mode {render_mode!r}, expected None or 'rgb_array'"
            )
        task = _shortened(task, max_episode_steps)
        how = {"render_size": (height, width), "camera_id": camera_id}
        self.env: SceneEnv = make_env(task, dynamics, num_envs, seed, device, **how)
        self.num_envs, self.render_mode = num_envs, render_mode
        self.metadata = {**self.metadata, "render_fps": round(1.0 / task.step_size)}
        shape, size = (task.observation_size,), (task.controller.num_actions,)
        self.single_observation_space = Box(-np.inf, np.inf, shape, np.float32)
        self.single_action_space = Box(-1.0, 1.0, size, np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._is_over = np.zeros(num_envs, bool)
        self._shown: np.ndarray | None = None  # the last observation

    def reset(
        self, *, seed: int | None = None, options: Info | None = None
    ) -> tuple[np.ndarray, Info]:
        """Begin an episode in each env, or in those of a mask.

        Args:
            seed: begin the first episode of its envs' streams.
            options: ``{"reset_mask": mask}``, bool ``(num_envs,)``; the other envs go on,
                and show what they last did.

        Raises:
            ValueError: unknown options, another mask, a mask of no env or together with a
                seed, or before any reset of all envs.
        """
        super().reset(seed=seed)
        mask = self._mask(seed, options or {})
        if seed is not None:
            self.env.set_seed(seed)
        self._is_over &= ~mask
        fresh = self._begin(mask)
        if self._shown is not None:
            fresh[~mask] = self._shown[~mask]
        self._shown = fresh
        return fresh.copy(), {}

    def _mask(self, seed: int | None, options: Info) -> np.ndarray:
        unknown = sorted(options.keys() - {"reset_mask"})
        if unknown:
            raise ValueError(f"unknown options {unknown}, expected reset_mask alone")
        mask = options.get("reset_mask")
        if mask is None:
            return np.ones(self.num_envs, bool)
        mask = np.asarray(mask)
        if mask.shape != (self.num_envs,) or mask.dtype != bool or not mask.any():
            raise ValueError(
                f"expected a reset_mask of bool, shape ({self.num_envs},), with an env to "
                f"reset, got {mask.dtype}, shape {mask.shape}, {np.sum(mask != 0)} envs"
            )
        if seed is not None or self._shown is None:
            got = "a seed" if seed is not None else "no reset before"
            raise ValueError(
                f"expected a reset_mask without a seed, after a reset of all, got {got}"
            )
        return mask

    def _begin(self, mask: np.ndarray) -> np.ndarray:
        """Begin episodes where the mask says; observations of all envs."""
        is_reset = torch.from_numpy(mask.copy())[:, None].to(self.env.device)
        fresh = self.env.reset(TensorDict({"_reset": is_reset}, self.env.batch_size))
        return _numpy(fresh[OBSERVATION])

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Info]:
        """Observations, rewards, terminated, truncated of all envs; an empty info.

        Raises:
            ResetNeeded: no reset before.
        """
        if self._shown is None:
            raise gymnasium.error.ResetNeeded("expected a reset before the first step")
        env, begins = self.env, self._is_over  # (num_envs,): whose action is ignored
        given = as_action(actions).to(env.device)
        after = env.step(TensorDict({ACTION: given}, env.batch_size))["next"]
        observation, reward = _numpy(after[OBSERVATION]), after["reward"].double()
        columns = reward, after["terminated"], after["truncated"]  # (num_envs, 1) each
        reward, terminated, truncated = (_numpy(x[:, 0]) for x in columns)
        if begins.any():
            observation[begins] = self._begin(begins)[begins]
            for column in (reward, terminated, truncated):
                column[begins] = 0
        self._is_over, self._shown = terminated | truncated, observation
        return observation.copy(), reward, terminated, truncated, {}

    def render(self) -> tuple[np.ndarray, ...] | None:
        """An image ``(height, width, 3)``, uint8, of each env; None without a mode."""
        if self.render_mode is None:
            gymnasium.logger.warn("no image: make the env with render_mode='rgb_array'")
            return None
        return tuple(self.env.render())

    def close_extras(self, **kwargs: Any) -> None:
        """Free what images were drawn with."""
        self.env.close()


class GymnasiumEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """One env: observation ``(D,)``, action ``(A,)`` in [-1, 1], both float32.

    Args:
        task, dynamics: see `make_env`.
        render_mode: ``"rgb_array"`` or None.
        settings: other arguments of `GymnasiumVectorEnv`, but ``num_envs``.

    Raises:
        TypeError: ``num_envs``, or an unknown argument.
        ValueError: see `GymnasiumVectorEnv`.
    """

    metadata: Info = {"render_modes": ["rgb_array"]}

    def __init__(
        self,
        task: str | Path | Scene | Task,
        dynamics: str | Path = "nerd",
        render_mode: str | None = None,
        **settings: Any,
    ) -> None:
        settings["render_mode"] = self.render_mode = render_mode
        self.vector = GymnasiumVectorEnv(task, dynamics, 1, **settings)
        fps = self.vector.metadata["render_fps"]
        self.metadata = {**self.metadata, "render_fps": fps}
        self.observation_space = self.vector.single_observation_space
        self.action_space = self.vector.single_action_space

    def reset(
        self, *, seed: int | None = None, options: Info | None = None
    ) -> tuple[np.ndarray, Info]:
        """Begin the next episode, or with a seed the first; ValueError for any options."""
        super().reset(seed=seed)
        if options:
            raise ValueError(f"expected no options, got {sorted(options)}")
        observation, info = self.vector.reset(seed=seed)
        return observation[0], info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, Info]:
        """Observation, reward, terminated, truncated, and an empty info."""
        *results, info = self.vector.step(np.asarray(action)[None])
        observation, reward, terminated, truncated = (x[0] for x in results)
        return observation, float(reward), bool(terminated), bool(truncated), info

    def render(self) -> np.ndarray | None:  # pyright: ignore
        """An image ``(height, width, 3)``, uint8; None without a mode."""
        images = self.vector.render()
        return None if images is None else images[0]

    def close(self) -> None:
        """Free what images were drawn with."""
        self.vector.close()


def _shortened(task: str | Path | Scene | Task, steps: int | None) -> Task:
    """The task, or a copy of it with that horizon where its own is longer."""
    task = make_task(task)
    if steps is not None:
        expect_count(1, max_episode_steps=steps)
    if steps is None or steps >= task.horizon:
        return task
    task = copy.copy(task)
    task.horizon = steps
    return task


def _numpy(x: Tensor) -> np.ndarray:
    return x.cpu().numpy().copy()


def gymnasium_id(task: str) -> str:
    """Gymnasium's id of a registered task: ``TorchrlNerd/AntSpinTrack-v0``."""
    words = task.replace("/", "_").split("_")
    return f"TorchrlNerd/{''.join(word.capitalize() for word in words)}-v0"


def _register(env_id: str, horizon: int | None = None, **kwargs: str) -> None:
    gymnasium.registry.pop(env_id, None)  # of a robot whose module was loaded before
    gymnasium.register(
        env_id,
        max_episode_steps=horizon,
        entry_point=f"{__name__}:GymnasiumEnv",
        vector_entry_point=f"{__name__}:GymnasiumVectorEnv",
        kwargs=kwargs,
    )


def _follow(task: str) -> None:
    """Register a task, or forget one that is gone."""
    if task in TASKS:
        horizon = getattr(TASKS[task], "horizon", None)
        _register(gymnasium_id(task), horizon, task=task)
    else:
        gymnasium.registry.pop(gymnasium_id(task), None)


_register("TorchrlNerd/Task-v0")  # any task, by its id as the argument ``task``
for_each_task(_follow)
