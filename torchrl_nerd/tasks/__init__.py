"""Tasks by id."""

from collections.abc import Callable

from torchrl_nerd.tasks.cartpole import CartpoleSwingup
from torchrl_nerd.tasks.double_pendulum import DoublePendulumPassive
from torchrl_nerd.tasks.task import Task

TASKS: dict[str, Callable[[], Task]] = {
    "cartpole/swingup": CartpoleSwingup,
    "double_pendulum/passive": DoublePendulumPassive,
}


def make_task(name: str) -> Task:
    """The registered task of that id.

    Raises:
        ValueError: no such task.
    """
    if name not in TASKS:
        raise ValueError(f"unknown task '{name}', expected one of {', '.join(TASKS)}")
    return TASKS[name]()


__all__ = ["TASKS", "Task", "make_task"]
