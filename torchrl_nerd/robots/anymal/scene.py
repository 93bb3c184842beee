"""ANYmal C of the NeRD paper: twelve joints, driven by springs to random targets."""

from functools import cache
from math import pi
from pathlib import Path

import mujoco
import torch
from torch import Generator, Tensor

from torchrl_nerd.geometry.constants import constant
from torchrl_nerd.scenes.controllers import TorqueController
from torchrl_nerd.scenes.penalty_law import set_penalty_contact, set_penalty_limit
from torchrl_nerd.scenes.sampling import BaseSampling, Sampling
from torchrl_nerd.scenes.scene import Scene

LEGS = ("LF", "RF", "LH", "RH")  # left and right, fore and hind
GAIN = (75.0, 60.0, 12.0) * 4  # N m per unit of action: HAA, HFE, KFE; reference code
SUBSTEPS = 10  # of 1/600 s; paper, appendix B
CONTROL_STEP = 1 / 60  # s
# N m/rad and N m s/rad, beyond the HAA's range; reference importer's limit_ke, limit_kd
LIMIT = {"ke": 1e3, "kd": 10.0}
# N/m, N s/m, N s/m, -. Means of the robot's and the ground's numbers, as the reference
# engine takes them, but half its dampings of 750 and 550 N s/m. MuJoCo damps explicitly: a
# substep of 1/600 s is stable below 2 m / dt, and a foot weighs as little as 0.475 kg
# along its shank, 0.88 kg upright. The whole damping rattles at 6 m/s when standing.
CONTACT = {"ke": 5.1e4, "kd": 375.0, "kf": 275.0, "mu": 0.625}

# The nominal pose of the published policies, knees outward, rad, leg by leg (HAA,
# HFE, KFE). The reference lists its numbers for LF, RF, LH, RH, but its importer orders
# the legs RH, LH, RF, LF; the usual pose (HFE +0.4 fore, knees inward) is the other one.
STANDING_POSE = (
    *(-0.03, -0.4, 0.8),
    *(0.03, -0.4, 0.8),
    *(-0.03, 0.4, -0.8),
    *(0.03, 0.4, -0.8),
)

KP, KD = 85.0, 2.0  # N m/rad, N m s/rad: the tasks' controller; reference code
ACTION_SCALE = 0.5  # rad per unit of action about the standing pose
RANDOM_KP = (30.0, 200.0)  # N m/rad; reference code, trajectory_sampler_anymal
RANDOM_KD = (0.0, 1.0)  # N m s/rad


@cache
def anymal() -> Scene:
    """Build the scene. ``qpos`` = base position (m), quaternion, joints (rad).

    Joints in the order of `LEGS`, each HAA, HFE, KFE.
    """
    model = mujoco.MjModel.from_xml_path(str(Path(__file__).with_name("anymal.xml")))
    set_penalty_contact(model, **CONTACT)
    set_penalty_limit(model, *(f"{leg}_HAA" for leg in LEGS), **LIMIT)
    sampling = Sampling(
        qpos_low=tuple(q - 0.2 for q in STANDING_POSE),
        qpos_high=tuple(q + 0.2 for q in STANDING_POSE),
        qvel_low=(-0.25,) * 12,
        qvel_high=(0.25,) * 12,
        torque=GAIN,
        base=BaseSampling(  # of the reference's data, as of its env
            low=(-0.2, -0.2, 0.65),
            high=(0.2, 0.2, 1.0),
            tilt=pi / 6,
            linear_low=(-0.1, -0.1, -0.1),
            linear_high=(0.1, 0.1, 0.1),
            angular_low=(-0.25, -0.25, -0.25),
            angular_high=(0.25, 0.25, 0.25),
        ),
        drive=random_pd,
        zero_torque_fraction=0.1,
        low_torque_fraction=0.4,
    )
    return Scene("anymal", model, SUBSTEPS, TorqueController(GAIN), sampling)


def random_pd(
    qpos: Tensor, qvel: Tensor, scale: Tensor, generator: Generator
) -> Tensor:
    """Springs and dampers to random targets about the standing pose, N m, ``(n, 12)``.

    target = pose + 0.5 a, a uniform in [-1, 1]. Trajectories of scale 1 are the
    reference's: Kp and Kd are drawn at every step, here per trajectory. A torque that
    is held over the control step dt adds energy as a damping of -Kp dt / 2 would. This
    much is added to Kd: without it a quarter of them would diverge within 100 steps.
    Quiet ones (0 < scale < 1) have the tasks' Kp and Kd and targets within ``scale`` of
    that range: they stand and shuffle as a policy would. Those of scale 0 are passive.
    """
    draw = torch.rand(len(qpos), 14, dtype=torch.float64, generator=generator)
    (low_kp, high_kp), (low_kd, high_kd) = RANDOM_KP, RANDOM_KD
    is_quiet = scale < 1.0
    kp = torch.where(is_quiet, KP, low_kp + (high_kp - low_kp) * draw[:, :1])
    kd = low_kd + (high_kd - low_kd) * draw[:, 1:2] + 0.5 * CONTROL_STEP * kp
    kd = torch.where(is_quiet, KD, kd)
    reach = ACTION_SCALE * scale * (2.0 * draw[:, 2:] - 1.0)
    offset = constant(draw, STANDING_POSE) + reach - qpos[:, 7:]
    return torch.where(scale > 0.0, kp * offset - kd * qvel[:, 6:], 0.0)
