"""Dynamics behind one call: ground truth, learned, hybrid, analytic."""

from torchrl_nerd.dynamics.base import Dynamics
from torchrl_nerd.dynamics.dm_control import DMControlDynamics
from torchrl_nerd.dynamics.guarded import Guard, GuardedDynamics, UntrustedError
from torchrl_nerd.dynamics.models import (
    AnalyticDynamics,
    Inference,
    Model,
    NeRDDynamics,
    TorchDynamics,
    dynamics_of,
)
from torchrl_nerd.dynamics.mujoco import MujocoDynamics
from torchrl_nerd.dynamics.mujoco_warp import MujocoWarpDynamics

__all__ = [
    "AnalyticDynamics",
    "DMControlDynamics",
    "Dynamics",
    "Guard",
    "GuardedDynamics",
    "Inference",
    "Model",
    "MujocoDynamics",
    "MujocoWarpDynamics",
    "NeRDDynamics",
    "TorchDynamics",
    "UntrustedError",
    "dynamics_of",
]
