"""TorchRL envs in any dynamics, with equal specs."""

from torchrl_nerd.envs.ground_truth import GroundTruthEnv
from torchrl_nerd.envs.make import make_env
from torchrl_nerd.envs.nerd import NeRDEnv
from torchrl_nerd.envs.stateless import StatelessEnv

__all__ = ["GroundTruthEnv", "NeRDEnv", "StatelessEnv", "make_env"]
