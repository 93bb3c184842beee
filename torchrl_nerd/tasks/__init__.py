"""Tasks by id."""

from collections.abc import Callable

from torchrl_nerd.tasks.ant import AntRun, AntSpin, AntSpinTrack
from torchrl_nerd.tasks.anymal import AnymalForward, AnymalSideways
from torchrl_nerd.tasks.cartpole import CartpoleSwingup
from torchrl_nerd.tasks.cube import CubeToss, RealCubeToss
from torchrl_nerd.tasks.double_pendulum import DoublePendulumPassive
from torchrl_nerd.tasks.franka import (
    FrankaGravityReachTorque,
    FrankaReach,
    FrankaReachTorque,
)
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
