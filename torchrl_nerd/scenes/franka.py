"""Franka Panda of the NeRD paper: seven joints, no gravity, no limits, no contact."""

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


Joints = tuple[float, ...]


def franka() -> Scene:
    """Build the scene. ``qpos`` = joint angles (rad).

    The masses are not those that the inertias belong to: so the reference has it. Angles
    are drawn from several turns, as there.
    """
    return arm_scene("franka", (-10.0,) * 7, (10.0,) * 7, TRAINING_TORQUE)


def arm_scene(name: str, low: Joints, high: Joints, torque: Joints) -> Scene:
    """An arm of that name in the assets, its ranges of angles (rad) and torque (N m)."""
    path = Path(__file__).parent / "assets" / f"{name}.xml"
    return Scene(
        name=name,
        model=mujoco.MjModel.from_xml_path(str(path)),
        substeps=SUBSTEPS,
        controller=TorqueController(GAIN),
        sampling=Sampling(
            qpos_low=low,
            qpos_high=high,
            qvel_low=(-pi,) * 7,
            qvel_high=(pi,) * 7,
            torque=torque,
        ),
    )
