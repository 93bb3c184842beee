"""What must not change the motion: position, heading, height, sign, whole turns."""

import mujoco
import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_nerd.dynamics import AnalyticDynamics, MujocoDynamics, NeRDDynamics
from torchrl_nerd.evaluation.stability.case import (
    Metrics,
    Trial,
    hard_case,
    has_floating_base,
    has_level_ground,
)
from torchrl_nerd.evaluation.stability.measures import largest
from torchrl_nerd.evaluation.stability.states import rotated, with_rotated_ground
from torchrl_nerd.evaluation.stability.stepper import DynamicsStepper, Stepper
from torchrl_nerd.geometry.rotations import rotate
from torchrl_nerd.keys import QPOS
from torchrl_nerd.scenes import Scene

HIGHER = "difference after 10 steps, 1 m to 1,000 km higher, m"
NEAR = "difference after 10 steps, 1 m to 10 km away, m or rad"
FAR = "difference after 10 steps, 1,000 km away, m or rad"
MEDIAN = "median difference after 10 steps, m or rad"
WORST = "largest difference after 10 steps, m or rad"
TURNS = "difference after 100 turns and 20 steps, rad"


def _shifted(
    trial: Trial,
    start: TensorDict,
    address: int,
    by: float,
    torque: Tensor | None = None,
) -> float:
    """Difference after 10 steps if one entry of ``qpos`` starts ``by`` farther."""
    other = start.clone()
    other[QPOS][:, address] += by
    here, there = (trial.roll(s, 10, torque) for s in (start, other))
    there[QPOS][..., address] -= by
    return largest(trial.difference(here, there))


@hard_case(has_floating_base, {HIGHER: 1e-6})
def altitude(trial: Trial) -> Metrics:
    """How far contact points are beyond their margin does not change the motion."""
    start, torque = trial.in_air(8), trial.torques(8, 10)
    z = trial.scene.base.qpos_address + 2
    shifts = [_shifted(trial, start, z, by, torque) for by in (1.0, 1e3, 1e6)]
    return {HIGHER: max(shifts)}


@hard_case(has_level_ground, {NEAR: 1e-4, FAR: 1e-2}, {NEAR: 1e-4})
def translation(trial: Trial) -> Metrics:
    """Level ground is the same everywhere; a float64 holds 1e-10 m at 1,000 km."""
    start, x = trial.starts(8), trial.scene.base.qpos_address
    *near, far = (_shifted(trial, start, x, by) for by in (1.0, 1e2, 1e4, 1e6))
    return {NEAR: max(near), FAR: far}


def _rotated(trial: Trial, other: Stepper, quat: Tensor) -> Metrics:
    """Difference between rotating the start and rotating the trajectory."""
    start = trial.starts(16)
    here = rotated(trial.scene, trial.roll(start, 10), quat[:, None])
    there = other.roll(rotated(trial.scene, start, quat), 10)
    worst = trial.difference(here, there).amax(1)
    return {MEDIAN: float(worst.median()), WORST: largest(worst)}


@hard_case(has_level_ground, {MEDIAN: 1e-4})
def yaw(trial: Trial) -> Metrics:
    """Level ground is the same in every direction, as is MuJoCo's elliptic cone."""
    half = torch.pi * trial.uniform(16, 1)
    zero = torch.zeros_like(half)
    quat = torch.cat((half.cos(), zero, zero, half.sin()), -1)
    return _rotated(trial, trial.stepper, quat)


@hard_case(has_level_ground, {MEDIAN: 1e-4}, needs="dynamics")
def tilt(trial: Trial) -> Metrics:
    """Robot, floor and gravity rotated together move alike."""
    quat = trial.normal(4)
    quat = quat / quat.norm()
    scene = with_rotated_ground(trial.scene, quat)
    gravity = torch.from_numpy(trial.scene.model.opt.gravity.copy())
    scene.model.opt.gravity[:] = rotate(quat, gravity).numpy()
    return _rotated(trial, _in_scene(trial.stepper, scene), quat.expand(16, 4))


def _in_scene(stepper: Stepper, scene: Scene) -> Stepper:
    """The same dynamics in another scene, whose features are the same."""
    dynamics = stepper.dynamics
    if isinstance(dynamics, AnalyticDynamics):
        step = dynamics.analytic_step.with_terrain(scene)
        return DynamicsStepper(AnalyticDynamics(step))
    if not isinstance(dynamics, NeRDDynamics):
        return DynamicsStepper(MujocoDynamics(scene))
    model = dynamics.model.copy_for(scene)
    model.load_state_dict(dynamics.model.state_dict())
    return DynamicsStepper(NeRDDynamics(model.to(dynamics.model.device)))


@hard_case(has_floating_base, {WORST: 1e-6})
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


@hard_case(lambda scene: bool(_free_hinges(scene)), {TURNS: 1e-6})
def hinge_turns(trial: Trial) -> Metrics:
    """A hundred turns of a hinge without limits change nothing."""
    start, torque = trial.starts(16), trial.torques(16, 20)
    other = start.clone()
    other[QPOS][:, _free_hinges(trial.scene)] += 200.0 * torch.pi
    paths = [trial.roll(s, 20, torque) for s in (start, other)]
    return {TURNS: largest(trial.difference(*paths))}
