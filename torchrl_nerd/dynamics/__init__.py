"""Dynamics behind one call: ground truth, learned, hybrid, analytic."""

from collections.abc import Callable

import torch

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
from torchrl_nerd.scenes import Scene

ENGINES: dict[str, Callable[[Scene, torch.device], Dynamics]] = {
    "mujoco": lambda scene, device: MujocoDynamics(scene),
    "dm_control": lambda scene, device: DMControlDynamics(scene),
    "mujoco_warp": MujocoWarpDynamics,
}
"""Ground truth by its name in `make_env`."""

__all__ = [
    "ENGINES",
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
