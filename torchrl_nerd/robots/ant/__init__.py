"""Ant of the NeRD paper."""

from torchrl_nerd.robots.ant.presets import PPO, PRESETS
from torchrl_nerd.robots.ant.scene import ant
from torchrl_nerd.robots.ant.tasks import AntRun, AntSpin, AntSpinTrack
from torchrl_nerd.robots.robot import Robot

ROBOT = Robot(
    scenes={"ant": ant},
    tasks={
        "ant/run": AntRun,
        "ant/spin": AntSpin,
        "ant/spin_track": AntSpinTrack,
    },
    presets=PRESETS,
    ppo=PPO,
)
