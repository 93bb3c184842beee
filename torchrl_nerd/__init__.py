"""Neural Robot Dynamics as composable TorchRL parts."""

__version__ = "0.1.0"

from torchrl_nerd.checkpoint import from_pretrained
from torchrl_nerd.envs import GroundTruthEnv, NeRDEnv, make_env
from torchrl_nerd.robots import load_scene
from torchrl_nerd.robots.registry import load_named_robots
from torchrl_nerd.scenes import Scene

__all__ = [
    "GroundTruthEnv",
    "NeRDEnv",
    "Scene",
    "from_pretrained",
    "load_scene",
    "make_env",
]

load_named_robots()  # last: their modules import all of this
