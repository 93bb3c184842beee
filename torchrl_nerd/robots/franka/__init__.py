"""Franka Panda: that of the NeRD paper, and the real arm under gravity."""

from torchrl_nerd.robots.franka.presets import PPO, PRESETS
from torchrl_nerd.robots.franka.scene import franka, franka_gravity
from torchrl_nerd.robots.franka.tasks import (
    FrankaGravityReachTorque,
    FrankaReach,
    FrankaReachTorque,
)
from torchrl_nerd.robots.robot import Robot

ROBOT = Robot(
    scenes={"franka": franka, "franka_gravity": franka_gravity},
    tasks={
        "franka/reach": FrankaReach,
        "franka/reach_torque": FrankaReachTorque,
        "franka_gravity/reach_torque": FrankaGravityReachTorque,
    },
    presets=PRESETS,
    ppo=PPO,
)
