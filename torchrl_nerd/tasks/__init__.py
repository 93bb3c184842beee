"""Tasks by id."""

from collections.abc import Callable

from torchrl_nerd.tasks.ant import AntRun, AntSpin, AntSpinTrack
from torchrl_nerd.tasks.anymal import AnymalForward, AnymalSideways
from torchrl_nerd.tasks.cartpole import CartpoleSwingup
from torchrl_nerd.tasks.cube import CubeToss, RealCubeToss, SlopeToss
from torchrl_nerd.tasks.double_pendulum import DoublePendulumPassive
from torchrl_nerd.tasks.franka import (
    FrankaGravityReachTorque,
    FrankaReach,
    FrankaReachTorque,
)
from torchrl_nerd.tasks.suite import SuiteTask
from torchrl_nerd.tasks.task import Task

TASKS: dict[str, Callable[[], Task]] = {
    "cartpole/swingup": CartpoleSwingup,
    "double_pendulum/passive": DoublePendulumPassive,
    "ant/run": AntRun,
    "ant/spin": AntSpin,
    "ant/spin_track": AntSpinTrack,
    "franka/reach": FrankaReach,
    "franka/reach_torque": FrankaReachTorque,
    "franka_gravity/reach_torque": FrankaGravityReachTorque,
    "anymal/forward": AnymalForward,
    "anymal/sideways": AnymalSideways,
    "cube/toss": CubeToss,
    "cube_real/toss": RealCubeToss,
    "cube_slope/toss": SlopeToss,
}


def make_task(name: str) -> Task:
    """The task of that id: a registered one or ``dm_control/DOMAIN-TASK``.

    Raises:
        ValueError: no such task, or one whose robot has something not supported (named).
    """
    if name in TASKS:
        return TASKS[name]()
    if name.startswith("dm_control/"):
        return SuiteTask(name)
    raise ValueError(
        f"unknown task '{name}', expected one of {', '.join(TASKS)} or "
        "dm_control/DOMAIN-TASK"
    )


__all__ = ["TASKS", "Task", "make_task"]
