"""Double pendulum of the NeRD paper, over planes."""

from torchrl_nerd.robots.double_pendulum.presets import PRESETS
from torchrl_nerd.robots.double_pendulum.scene import double_pendulum
from torchrl_nerd.robots.double_pendulum.tasks import DoublePendulumPassive
from torchrl_nerd.robots.robot import Robot

ROBOT = Robot(
    scenes={"double_pendulum": double_pendulum},
    tasks={"double_pendulum/passive": DoublePendulumPassive},
    presets=PRESETS,
)
