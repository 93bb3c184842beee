"""What must not change the motion: position, heading, height, sign, whole turns."""

import mujoco
import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_nerd.evaluation.stability.case import (
    Metrics,
    Trial,
    hard_case,
    has_floating_base,
    largest,
)
from torchrl_nerd.evaluation.stability.states import rotated
from torchrl_nerd.keys import QPOS
from torchrl_nerd.scenes import Scene

HIGHER = "difference after 10 steps, 1 m to 1,000 km higher, m"
NEAR = "difference after 10 steps, 1 m to 10 km away, m or rad"
FAR = "difference after 10 steps, 1,000 km away, m or rad"
MEDIAN = "median difference after 10 steps, m or rad"
WORST = "largest difference after 10 steps, m or rad"
TURNS = "difference after 100 turns and 20 steps, rad"


def _has_level_ground(scene: Scene) -> bool:
    """Whether a floating base moves over one fixed plane."""
    plane = scene.terrain is not None and scene.terrain.fixed_plane is not None
    return scene.base.is_floating and plane


def _shifted(
    trial: Trial,
    start: TensorDict,
    address: int | list[int],
    by: float,
    torque: Tensor | None = None,
    steps: int = 10,
) -> float:
    """Difference after some steps if entries of ``qpos`` start ``by`` farther."""
    other = start.clone()
    other[QPOS][:, address] += by
    here, there = (trial.roll(s, steps, torque) for s in (start, other))
    there[QPOS][..., address] -= by
    return largest(trial.difference(here, there))


@hard_case({HIGHER: 1e-6}, applies=has_floating_base)
def altitude(trial: Trial) -> Metrics:
    """How far contact points are beyond their margin does not change the motion."""
    start, torque = trial.in_air(8, speed=1.0), trial.torques(8, 10)
    z = trial.scene.base.qpos_address + 2
    shifts = [_shifted(trial, start, z, by, torque) for by in (1.0, 1e3, 1e6)]
    return {HIGHER: max(shifts)}


@hard_case({NEAR: 1e-4, FAR: 1e-2}, {NEAR: 1e-4}, _has_level_ground)
def translation(trial: Trial) -> Metrics:
    """Level ground is the same everywhere; a float64 holds 1e-10 m at 1,000 km."""
    start, x = trial.starts(8), trial.scene.base.qpos_address
    *near, far = (_shifted(trial, start, x, by) for by in (1.0, 1e2, 1e4, 1e6))
    return {NEAR: max(near), FAR: far}


@hard_case({MEDIAN: 1e-4}, applies=_has_level_ground)
def yaw(trial: Trial) -> Metrics:
    """Level ground is the same in every direction, as is MuJoCo's elliptic cone."""
    start = trial.starts(16)
    w, z = torch.nn.functional.normalize(trial.normal(16, 2)).unbind(-1)
    zero = torch.zeros_like(w)
    quat = torch.stack((w, zero, zero, z), -1)  # (16, 4)
    here = rotated(trial.scene, trial.roll(start, 10), quat[:, None])
    there = trial.roll(rotated(trial.scene, start, quat), 10)
    worst = trial.difference(here, there).amax(1)
    return {MEDIAN: float(worst.median()), WORST: largest(worst)}


@hard_case({WORST: 1e-6}, applies=has_floating_base)
def quaternion_sign(trial: Trial) -> Metrics:
    """A quaternion q and its negative -q are one orientation."""
    q = trial.scene.base.qpos_address + 3
    start, torque = trial.starts(16), trial.torques(16, 10)
    other = start.clone()
    other[QPOS][:, q : q + 4] *= -1.0
    paths = [trial.roll(s, 10, torque) for s in (start, other)]
    return {WORST: largest(trial.difference(*paths))}


def _free_hinges(scene: Scene) -> list[int]:
    """Addresses in ``qpos`` of hinges without limit and spring."""
    model = scene.model
    is_free = model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE
    is_free &= (model.jnt_limited == 0) & (model.jnt_stiffness == 0)
    return model.jnt_qposadr[is_free].tolist()


@hard_case({TURNS: 1e-6}, applies=lambda scene: bool(_free_hinges(scene)))
def hinge_turns(trial: Trial) -> Metrics:
    """A hundred turns of a hinge without limits change nothing."""
    start, torque = trial.starts(16), trial.torques(16, 20)
    turns, hinges = 200.0 * torch.pi, _free_hinges(trial.scene)
    return {TURNS: _shifted(trial, start, hinges, turns, torque, steps=20)}
