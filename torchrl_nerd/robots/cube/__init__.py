"""Cubes: the paper's on level ground, over slopes, and the measured one."""

from torchrl_nerd.robots.cube.presets import PRESETS
from torchrl_nerd.robots.cube.scene import cube, cube_real, cube_slope
from torchrl_nerd.robots.cube.tasks import CubeToss, RealCubeToss, SlopeToss
from torchrl_nerd.robots.robot import Robot

ROBOT = Robot(
    scenes={"cube": cube, "cube_real": cube_real, "cube_slope": cube_slope},
    tasks={
        "cube/toss": CubeToss,
        "cube_real/toss": RealCubeToss,
        "cube_slope/toss": SlopeToss,
    },
    presets=PRESETS,
)
