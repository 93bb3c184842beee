"""ANYmal C of the NeRD paper."""

from torchrl_nerd.robots.anymal.presets import PPO, PRESETS
from torchrl_nerd.robots.anymal.scene import anymal
from torchrl_nerd.robots.anymal.tasks import AnymalForward, AnymalSideways
from torchrl_nerd.robots.robot import Robot

ROBOT = Robot(
    scenes={"anymal": anymal},
    tasks={"anymal/forward": AnymalForward, "anymal/sideways": AnymalSideways},
    presets=PRESETS,
    ppo=PPO,
)
