"""Cartpole of the NeRD paper."""

from torchrl_nerd.robots.cartpole.presets import PPO, PRESETS
from torchrl_nerd.robots.cartpole.scene import cartpole
from torchrl_nerd.robots.cartpole.tasks import CartpoleSwingup
from torchrl_nerd.robots.robot import Robot

ROBOT = Robot(
    scenes={"cartpole": cartpole},
    tasks={"cartpole/swingup": CartpoleSwingup},
    presets=PRESETS,
    ppo=PPO,
)
