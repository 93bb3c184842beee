"""Double pendulum of the NeRD paper over a plane that differs from env to env."""

from functools import cache
from math import cos, pi, sin
from pathlib import Path

import mujoco
import torch
from torch import Generator, Tensor

from torchrl_nerd.scenes.controllers import TorqueController
from torchrl_nerd.scenes.penalty_law import set_penalty_contact
from torchrl_nerd.scenes.sampling import Sampling
from torchrl_nerd.scenes.scene import Scene

GAIN = 1500.0  # N m per unit of action, both joints; env_pendulum_with_contact
SUBSTEPS = 5  # of 1/300 s: control step 1/60 s
CONTACT = {"ke": 1e4, "kd": 1e3, "kf": 1e4, "mu": 0.5}  # N/m, N s/m, N s/m, -
LINK_LENGTH = 1.5  # m
RADIUS = 0.1  # m
LEVEL_TILT = 0.15  # rad
ROOT = (0.0, -1.0, 2.0)  # m, world; (0, 2, 1) in the reference's axes

# Evaluation grounds: offset (m) along the up axis of the plane's point, and extrinsic
# xyz Euler angles (rad) of the normal, in the reference's axes (y up).
# Number 0 is out of reach.
GROUNDS = (
    (-15.5, (0.0, 0.0, 0.0)),
    (0.0, (0.0, 0.0, 0.0)),
    (0.2, (pi / 8, pi / 16, pi / 16)),
    (0.5, (0.0, 0.0, 0.0)),
    (-0.5, (0.0, 0.0, 0.0)),
    (-0.3, (0.0, 0.0, 0.0)),
    (0.0, (pi / 8, 0.0, 0.0)),
)
ASSET = Path(__file__).with_name("double_pendulum.xml")


@cache
def double_pendulum() -> Scene:
    """Build the scene. ``qpos`` = hinge angles; zero is both links along +x."""
    model = mujoco.MjModel.from_xml_path(str(ASSET))
    set_penalty_contact(model, **CONTACT)
    sampling = Sampling(
        qpos_low=(-pi, -pi),
        qpos_high=(pi, pi),
        qvel_low=(-2 * pi, -4 * pi),
        qvel_high=(2 * pi, 4 * pi),
        torque=(GAIN, GAIN),
        ground=sample_ground,
        level_ground=sample_level_ground,
    )
    controller = TorqueController((GAIN, GAIN))
    return Scene("double_pendulum", model, SUBSTEPS, controller, sampling)


def sample_ground(qpos: Tensor, generator: Generator) -> Tensor:
    """Random planes ``(n, 4)`` that the pendulum at ``qpos (n, 2)`` does not penetrate.

    The normal is a normalised U(-1, 1)^3; the offset is uniform between out of reach of
    the stretched pendulum (3.5 m from the root) and touching its lowest point.
    Source: reference code, ``generate/trajectory_sampler_pendulum.py``.
    """
    draw = torch.rand(len(qpos), 4, dtype=torch.float64, generator=generator)
    normal = torch.nn.functional.normalize(2.0 * draw[:, :3] - 1.0, dim=-1)  # (n, 3)
    return _plane(normal, qpos, draw[:, 3])


def sample_level_ground(qpos: Tensor, generator: Generator) -> Tensor:
    """Planes ``(n, 4)`` that the links hit head-on; not in the paper.

    Four of its grounds have normals in the plane of motion, of which `sample_ground` draws
    none. Here half of the trajectories have one, the others tilt out of it by up to
    `LEVEL_TILT`; offsets as there.
    """
    draw = torch.rand(len(qpos), 4, dtype=torch.float64, generator=generator)
    angle = 2.0 * pi * draw[:, 0]
    tilt = (2.0 * draw[:, 1] - 1.0) * LEVEL_TILT * (draw[:, 2] < 0.5)
    across = tilt.cos()
    normal = torch.stack((across * angle.cos(), tilt.sin(), across * angle.sin()), -1)
    return _plane(normal, qpos, draw[:, 3])


def _plane(normal: Tensor, qpos: Tensor, draw: Tensor) -> Tensor:
    """At a uniform offset from out of reach of the links to touching them."""
    root = normal @ torch.tensor(ROOT, dtype=torch.float64)
    first, second = qpos[:, 0], qpos[:, 0] + qpos[:, 1]
    elbow = LINK_LENGTH * (normal[:, 0] * first.cos() + normal[:, 2] * first.sin())
    tip = LINK_LENGTH * (normal[:, 0] * second.cos() + normal[:, 2] * second.sin())
    lowest = root + torch.stack((torch.zeros_like(root), elbow, elbow + tip)).amin(0)
    low, high = root - 3.5, lowest - RADIUS
    return torch.cat((normal, (low + (high - low) * draw)[:, None]), -1)


def evaluation_ground(number: int) -> Tensor:
    """Plane ``(4,)`` of an evaluation ground, 0 (out of reach) to 6; else ValueError."""
    if not 0 <= number < len(GROUNDS):
        raise ValueError(
            f"expected a ground from 0 to {len(GROUNDS) - 1}, got {number}"
        )
    offset, (a, b, c) = GROUNDS[number]
    # R_z(c) R_y(b) R_x(a) applied to y, then the reference's axes (y up) to ours (z up)
    x, y, z = 0.0, cos(a), sin(a)
    x, z = x * cos(b) + z * sin(b), -x * sin(b) + z * cos(b)
    x, y = x * cos(c) - y * sin(c), x * sin(c) + y * cos(c)
    return torch.tensor([x, -z, y, y * offset], dtype=torch.float64)
