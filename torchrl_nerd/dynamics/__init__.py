"""Dynamics behind one call: ground truth, learned, hybrid, analytic."""

from torchrl_nerd.dynamics.analytic import AnalyticDynamics
from torchrl_nerd.dynamics.base import Dynamics
from torchrl_nerd.dynamics.dm_control import DMControlDynamics
from torchrl_nerd.dynamics.guarded import GuardedDynamics, UntrustedError
from torchrl_nerd.dynamics.mujoco import MujocoDynamics
from torchrl_nerd.dynamics.mujoco_warp import MujocoWarpDynamics
from torchrl_nerd.dynamics.nerd import NeRDDynamics
from torchrl_nerd.dynamics.of_model import Model, dynamics_of

__all__ = [
    "AnalyticDynamics",
    "DMControlDynamics",
    "Dynamics",
    "GuardedDynamics",
    "Model",
    "MujocoDynamics",
    "MujocoWarpDynamics",
    "NeRDDynamics",
    "UntrustedError",
    "dynamics_of",
]
