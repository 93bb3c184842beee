"""One argument switches between learned and true dynamics."""

from pathlib import Path

import torch

from torchrl_nerd.envs.base import SceneEnv
from torchrl_nerd.envs.ground_truth import GroundTruthEnv
from torchrl_nerd.envs.nerd import NeRDEnv
from torchrl_nerd.tasks import Task

GROUND_TRUTH = ("mujoco", "dm_control")


def make_env(
    task: str | Task,
    dynamics: str | Path = "nerd",
    num_envs: int = 1,
    seed: int = 0,
    device: torch.device | str = "cpu",
) -> SceneEnv:
    """A batched env of a task in the dynamics of your choice.

    Args:
        task: id of a registered task, or a task.
        dynamics: ``"nerd"`` (the shipped model), ``"mujoco"``, ``"dm_control"``, or the
            folder of a checkpoint.
        num_envs: rows.
        seed: of the resets.
        device: where all tensors live.

    Raises:
        ValueError: unknown task or dynamics, named in one sentence.
    """
    if dynamics in GROUND_TRUTH:
        return GroundTruthEnv(task, str(dynamics), num_envs, seed, device)  # pyright: ignore
    if dynamics == "nerd":
        return NeRDEnv(task, None, num_envs, seed, device)
    if not Path(dynamics).is_dir():
        raise ValueError(
            f"unknown dynamics '{dynamics}', expected nerd, "
            f"{', '.join(GROUND_TRUTH)} or a checkpoint folder"
        )
    return NeRDEnv(task, dynamics, num_envs, seed, device)
