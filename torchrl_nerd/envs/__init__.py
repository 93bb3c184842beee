"""TorchRL envs in learned and true dynamics, with equal specs."""

from torchrl_nerd.envs.ground_truth import GroundTruthEnv
from torchrl_nerd.envs.make import make_env
from torchrl_nerd.envs.nerd import NeRDEnv

__all__ = ["GroundTruthEnv", "NeRDEnv", "make_env"]
