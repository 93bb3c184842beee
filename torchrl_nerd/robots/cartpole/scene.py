"""Cartpole of the NeRD paper: a 50 kg cart on a rail, a 2.5 kg pole, 1500 N."""

from functools import cache
from math import pi
from pathlib import Path

import mujoco

from torchrl_nerd.scenes.controllers import TorqueController
from torchrl_nerd.scenes.penalty_law import set_penalty_limit
from torchrl_nerd.scenes.sampling import Sampling
from torchrl_nerd.scenes.scene import Scene

GAIN = 1500.0  # N per unit of action; reference code, env_cartpole
# N/m and N s/m, beyond +-4 m; reference URDF importer's limit_ke, limit_kd
LIMIT = {"ke": 1e4, "kd": 10.0}
SUBSTEPS = 5  # of 1/300 s: control step 1/60 s; paper, appendix B


@cache
def cartpole() -> Scene:
    """Build the scene. ``qpos`` = (cart x, pole angle from upright)."""
    path = Path(__file__).with_name("cartpole.xml")
    model = mujoco.MjModel.from_xml_path(str(path))
    set_penalty_limit(model, "slider", **LIMIT)
    sampling = Sampling(
        qpos_low=(-3.5, -pi),
        qpos_high=(3.5, pi),
        qvel_low=(-10.0, -10.0),
        qvel_high=(10.0, 10.0),
        torque=(GAIN,),
    )
    return Scene("cartpole", model, SUBSTEPS, TorqueController((GAIN,)), sampling)
