"""Franka Panda under gravity, with the inertials that were identified on the real arm."""

from math import pi
from pathlib import Path

import mujoco

from torchrl_nerd.scenes.controllers import TorqueController
from torchrl_nerd.scenes.franka import GAIN, SUBSTEPS
from torchrl_nerd.scenes.sampling import Sampling
from torchrl_nerd.scenes.scene import Scene

LOW = (-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973)  # rad; data sheet
HIGH = (2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973)


def franka_gravity() -> Scene:
    """Build the scene. ``qpos`` = joint angles (rad), all limited.

    Inertials (Gaz et al. 2019, https://doi.org/10.1109/LRA.2019.2931248), limits, damping
    (1 N m s/rad) and armature (0.1 kg m^2) of MuJoCo Menagerie's arm without a hand; time
    steps and torques of the paper's.
    """
    path = Path(__file__).parent / "assets" / "franka_gravity.xml"
    return Scene(
        name="franka_gravity",
        model=mujoco.MjModel.from_xml_path(str(path)),
        substeps=SUBSTEPS,
        controller=TorqueController(GAIN),
        sampling=Sampling(
            qpos_low=LOW,
            qpos_high=HIGH,
            qvel_low=(-pi,) * 7,
            qvel_high=(pi,) * 7,
            torque=GAIN,
        ),
    )
