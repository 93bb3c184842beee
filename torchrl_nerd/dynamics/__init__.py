"""Physics behind one call: true (MuJoCo, dm_control, MuJoCo Warp) and learned (NeRD)."""

from torchrl_nerd.dynamics.base import Dynamics
from torchrl_nerd.dynamics.dm_control import DMControlDynamics
from torchrl_nerd.dynamics.guarded import GuardedDynamics, UntrustedError
from torchrl_nerd.dynamics.mujoco import MujocoDynamics
from torchrl_nerd.dynamics.mujoco_warp import MujocoWarpDynamics
from torchrl_nerd.dynamics.nerd import NeRDDynamics

__all__ = [
    "DMControlDynamics",
    "Dynamics",
    "GuardedDynamics",
    "MujocoDynamics",
    "MujocoWarpDynamics",
    "NeRDDynamics",
    "UntrustedError",
]
