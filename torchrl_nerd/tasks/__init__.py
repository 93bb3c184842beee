"""Tasks: where episodes start, what the policy sees, what it earns, when they end."""

from torchrl_nerd.tasks.scene_task import SceneTask
from torchrl_nerd.tasks.task import Task

__all__ = ["SceneTask", "Task"]
