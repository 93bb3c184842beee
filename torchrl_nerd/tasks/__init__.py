"""Tasks: where episodes start, what the policy sees, what it earns, when they end."""

from torchrl_nerd.tasks.task import SceneTask, Task

__all__ = ["SceneTask", "Task"]
