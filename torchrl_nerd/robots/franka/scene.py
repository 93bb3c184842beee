"""Franka Panda: that of the NeRD paper, and the real arm under gravity, with limits."""

from functools import cache
from math import pi
from pathlib import Path

import mujoco

from torchrl_nerd.scenes.controllers import TorqueController
from torchrl_nerd.scenes.sampling import Sampling
from torchrl_nerd.scenes.scene import Scene

GAIN = (87.0,) * 4 + (12.0,) * 3  # N m per unit of action: effort limits
SUBSTEPS = 9  # of 1/1080 s: control step 1/120 s; paper, appendix B
TRAINING_TORQUE = (100.0,) * 4 + (20.0,) * 3  # N m; reference code, utils/commons.py
HOME = (0.0, -0.7853, 0.0, -2.3575, 0.0, 1.5703, 0.7857)  # rad; reference code

LOW = (-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973)  # rad; data sheet
HIGH = (2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973)

Joints = tuple[float, ...]


@cache
def franka() -> Scene:
    """Build the scene. ``qpos`` = joint angles (rad).

    The masses are not those that the inertias belong to: so the reference has it. Angles
    are drawn from several turns, as there.
    """
    return _arm("franka", (-10.0,) * 7, (10.0,) * 7, TRAINING_TORQUE)


@cache
def franka_gravity() -> Scene:
    """Build the scene. ``qpos`` = joint angles (rad), all limited.

    Inertials (Gaz et al. 2019, https://doi.org/10.1109/LRA.2019.2931248), limits, damping
    (1 N m s/rad) and armature (0.1 kg m^2) of MuJoCo Menagerie's arm without a hand; time
    steps and torques of the paper's.
    """
    return _arm("franka_gravity", LOW, HIGH, GAIN)


def _arm(name: str, low: Joints, high: Joints, torque: Joints) -> Scene:
    """The arm in the MJCF file of that name; ranges of angles in rad, torque in N m."""
    model = mujoco.MjModel.from_xml_path(str(Path(__file__).with_name(f"{name}.xml")))
    sampling = Sampling(low, high, (-pi,) * 7, (pi,) * 7, torque)
    return Scene(name, model, SUBSTEPS, TorqueController(GAIN), sampling)
