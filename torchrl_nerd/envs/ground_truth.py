"""A task in ground-truth dynamics."""

from collections.abc import Callable
from pathlib import Path
from typing import Literal

import torch

from torchrl_nerd.dynamics import (
    DMControlDynamics,
    Dynamics,
    MujocoDynamics,
    MujocoWarpDynamics,
)
from torchrl_nerd.dynamics.warp_setup import is_warp_installed
from torchrl_nerd.envs.base import SceneEnv
from torchrl_nerd.robots import make_task
from torchrl_nerd.scenes import Scene
from torchrl_nerd.tasks import Task

Engine = Literal["mujoco", "dm_control", "mujoco_warp"]
ENGINES: dict[str, Callable[[Scene, torch.device | str], Dynamics]] = {
    "mujoco": lambda scene, device: MujocoDynamics(scene),
    "dm_control": lambda scene, device: DMControlDynamics(scene),
    "mujoco_warp": MujocoWarpDynamics,
}
GROUND_TRUTH = tuple(e for e in ENGINES if e != "mujoco_warp" or is_warp_installed())
"""Those that can be used here."""


class GroundTruthEnv(SceneEnv):
    """A `SceneEnv` on MuJoCo's batched rollout, dm_control's `Physics` or MuJoCo Warp.

    Args:
        task: id of a registered task, or a task.
        engine: ``"mujoco"``, ``"dm_control"`` or ``"mujoco_warp"``.
        num_envs: how many envs.
        seed: of the resets.
        device: where states, observations and rewards live, and where MuJoCo Warp runs;
            the others run on the CPU.
        dump_dir: see `SceneEnv`.

    Raises:
        ValueError: an unknown engine, or one that cannot step this scene.
        ModuleNotFoundError: MuJoCo Warp is asked for and not installed.

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
        dump_dir: Path | None = None,
    ) -> None:
        if engine not in ENGINES:
            raise ValueError(
                f"unknown engine '{engine}', expected one of {', '.join(GROUND_TRUTH)}"
            )
        task = make_task(task) if isinstance(task, str) else task
        dynamics = ENGINES[engine](task.scene, device)
        super().__init__(task, dynamics, num_envs, seed, device, dump_dir)
