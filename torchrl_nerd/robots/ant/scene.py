"""Ant of the NeRD paper: 117 kg, eight joints, 400 N m, over level ground."""

from functools import cache
from math import pi
from pathlib import Path

import mujoco

from torchrl_nerd.scenes.controllers import TorqueController
from torchrl_nerd.scenes.penalty_law import set_penalty_contact, set_penalty_limit
from torchrl_nerd.scenes.sampling import BaseSampling, Sampling
from torchrl_nerd.scenes.scene import Scene

JOINTS = tuple(f"{joint}_{leg}" for leg in (1, 2, 3, 4) for joint in ("hip", "ankle"))
GAIN = 400.0  # N m per unit of action, all joints; reference code, env_ant
SUBSTEPS = 16  # of 1/960 s: control step 1/60 s; paper, appendix B
# N m/rad and N m s/rad, beyond the range; reference importer's limit_ke, limit_kd
LIMIT = {"ke": 1e3, "kd": 100.0}
# Means of the robot's and the ground's numbers, as the reference engine takes them:
# N/m, N s/m, N s/m, -
CONTACT = {"ke": 7e4, "kd": 550.0, "kf": 2e3, "mu": 0.625}
STANDING_POSE = (0.0, 1.0, 0.0, -1.0, 0.0, -1.0, 0.0, 1.0)  # rad, as JOINTS
HIP = 2 * pi / 9  # 40 deg
ANKLE = (pi / 6, 5 * pi / 9)  # 30 to 100 deg; legs 2 and 3 mirror it


@cache
def ant() -> Scene:
    """Build the scene. ``qpos`` = torso position (m), quaternion, joints (rad)."""
    model = mujoco.MjModel.from_xml_path(str(Path(__file__).with_name("ant.xml")))
    set_penalty_contact(model, **CONTACT)
    set_penalty_limit(model, *JOINTS, **LIMIT)
    near, far = ANKLE
    sampling = Sampling(  # reference code, utils/commons.py
        qpos_low=(-HIP, near, -HIP, -far, -HIP, -far, -HIP, near),
        qpos_high=(HIP, far, HIP, -near, HIP, -near, HIP, far),
        qvel_low=(-2 * pi,) * 8,
        qvel_high=(2 * pi,) * 8,
        torque=(GAIN,) * 8,
        base=BaseSampling(
            low=(-10.0, -10.0, 1.0),
            high=(10.0, 10.0, 1.3),
            tilt=pi / 2,
            linear_low=(-1.0, -1.0, -1.0),
            linear_high=(1.0, 1.0, 1.0),
            angular_low=(-pi, -pi, -pi),
            angular_high=(pi, pi, pi),
        ),
    )
    return Scene("ant", model, SUBSTEPS, TorqueController((GAIN,) * 8), sampling)
