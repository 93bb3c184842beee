"""TorchRL envs in any dynamics, with equal specs."""

from torchrl_nerd.envs.make import GroundTruthEnv, NeRDEnv, make_env
from torchrl_nerd.envs.stateless import StatelessEnv

__all__ = ["GroundTruthEnv", "NeRDEnv", "StatelessEnv", "make_env"]
