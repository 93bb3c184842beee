"""Neural Robot Dynamics as composable TorchRL parts."""

import os

__version__ = "0.1.0"

# GNU's OpenMP reads it when torch is first imported. Its threads else wait in a loop for
# long: on a loaded machine training takes a multiple of the time (docs/howto/machine.md).
os.environ.setdefault("GOMP_SPINCOUNT", "1000")

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
