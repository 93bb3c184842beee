"""A task in true dynamics."""

from pathlib import Path
from typing import Literal

import torch

from torchrl_nerd.dynamics import DMControlDynamics, MujocoDynamics
from torchrl_nerd.envs.base import SceneEnv
from torchrl_nerd.tasks import Task, make_task

Engine = Literal["mujoco", "dm_control"]


class GroundTruthEnv(SceneEnv):
    """A `SceneEnv` on MuJoCo's batched rollout or on dm_control's `Physics`.

    Args:
        task: id of a registered task, or a task.
        engine: ``"mujoco"`` or ``"dm_control"``.
        num_envs: rows.
        seed: of the resets.
        device: where states, observations and rewards live; the physics runs on the CPU.
        fault_folder: see `SceneEnv`.

    Raises:
        ValueError: an unknown engine.

    Examples:
        >>> env = GroundTruthEnv("cartpole/swingup", num_envs=3)
        >>> env.rollout(5, break_when_any_done=False)["next", "qpos"].shape
        torch.Size([3, 5, 2])
    """

    def __init__(
        self,
        task: str | Task,
        engine: Engine = "mujoco",
        num_envs: int = 1,
        seed: int = 0,
        device: torch.device | str = "cpu",
        fault_folder: Path | None = None,
    ) -> None:
        engines = {"mujoco": MujocoDynamics, "dm_control": DMControlDynamics}
        if engine not in engines:
            raise ValueError(
                f"unknown engine '{engine}', expected one of {', '.join(engines)}"
            )
        task = make_task(task) if isinstance(task, str) else task
        dynamics = engines[engine](task.scene)
        super().__init__(task, dynamics, num_envs, seed, device, fault_folder)
