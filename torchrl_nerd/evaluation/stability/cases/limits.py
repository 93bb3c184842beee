"""Joint limits, extreme torques, and a hundred thousand steps."""

from typing import cast

import mujoco
import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_nerd.dynamics import NeRDDynamics
from torchrl_nerd.evaluation.stability.case import (
    Metrics,
    Trial,
    hard_case,
    has_motors,
)
from torchrl_nerd.evaluation.stability.measures import largest, norm
from torchrl_nerd.evaluation.stability.states import extreme_torques, perturbed
from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.scenes import Scene

PERTURBATION, NUM_PERTURBED = 1e-2, 4  # m/s and rad/s: a model's own error of a step
EXCEEDED = "limit exceeded by more than in MuJoCo, rad or m"
NON_FINITE = "non-finite trajectories"
SPEED = "largest speed, m/s or rad/s"
LEAP = "distance beyond the speed bound times time, m"
KEPT = 1000  # states of a long rollout
ROUNDING = 1e-6


def _limited(scene: Scene) -> tuple[list[int], Tensor]:
    """Addresses ``(J)`` in ``qpos`` and ranges ``(J, 2)`` of limited hinges and slides."""
    model = scene.model
    scalar = (mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE)
    found = [
        joint
        for joint in range(model.njnt)
        if model.jnt_limited[joint] and model.jnt_type[joint] in scalar
    ]
    ranges = torch.from_numpy(model.jnt_range[found])
    return [int(model.jnt_qposadr[joint]) for joint in found], ranges


def _exceeded(scene: Scene, path: TensorDict) -> Tensor:
    """How far beyond its limit each joint went, ``(n, joints)``."""
    addresses, ranges = _limited(scene)
    position = cast(Tensor, path[QPOS])[..., addresses]
    low, high = ranges.unbind(-1)
    return torch.maximum(low - position, position - high).amax(1).clamp(min=0.0)


@hard_case(
    lambda scene: bool(_limited(scene)[0]) and has_motors(scene),
    {EXCEEDED: 0.2},
    {EXCEEDED: 1e-9},
)
def joint_limits(trial: Trial) -> Metrics:
    """Full torque presses no joint farther beyond its limit than in MuJoCo."""
    scene, start = trial.scene, trial.starts(16)
    high = torch.tensor(scene.sampling.torque, dtype=torch.float64)
    side = torch.randint(2, (16, 1, len(high)), generator=trial.generator)
    torque = (2.0 * side - 1.0) * high
    starts = [start]
    for _ in range(NUM_PERTURBED):
        starts.append(perturbed(start, PERTURBATION, trial.generator))
    own = _exceeded(scene, trial.roll(start, 200, torque))
    exact = torch.stack(
        [_exceeded(scene, trial.ground_truth.roll(s, 200, torque)) for s in starts]
    )
    name = "limit exceeded in MuJoCo, rad or m"
    return {EXCEEDED: largest(own - exact.amax(0)), name: largest(exact[0])}


def _is_broken(path: TensorDict) -> Tensor:
    """Which trajectories have a value that is not finite, ``(n,)``."""
    state = torch.cat((path[QPOS], path[QVEL]), -1)
    return (~state.isfinite()).flatten(1).any(1)


@hard_case(has_motors, {NON_FINITE: 0.0, SPEED: 1e3}, {})
def torques(trial: Trial) -> Metrics:
    """Zero, largest, 1000-fold and alternating torques leave every state finite."""
    metrics: Metrics = {NON_FINITE: 0.0, SPEED: 0.0}
    steps = trial.scaled(1000, 20)
    for name, torque in extreme_torques(trial.scene, 4, 2).items():
        path = trial.roll(trial.starts(4), steps, torque, steps // 20)
        metrics[NON_FINITE] += float(_is_broken(path).sum())
        speed = float(path[QVEL].abs().nan_to_num(0.0, 0.0, 0.0).amax())
        metrics[f"largest speed, {name}"] = speed
        metrics[SPEED] = max(metrics[SPEED], speed)
    return metrics


@hard_case(tolerances={NON_FINITE: 0.0, LEAP: 0.0}, ground_truth={})
def horizon(trial: Trial) -> Metrics:
    """Over 100,000 steps states stay finite and move no farther than their speed allows."""
    scene, steps = trial.scene, trial.scaled(100_000, KEPT) // KEPT * KEPT
    torque = trial.torques(4, 512)
    if has_motors(scene):
        torque = torch.cat((torque, *extreme_torques(scene, 4, 512).values()))
    path = trial.roll(trial.starts(len(torque)), steps, torque, steps // KEPT)
    is_broken = _is_broken(path)
    metrics = {
        NON_FINITE: float(is_broken.sum()),
        SPEED: float(path[QVEL][~is_broken].abs().amax()),
        LEAP: 0.0,
    }
    if scene.base.is_floating and isinstance(trial.stepper.dynamics, NeRDDynamics):
        q, v = scene.base.qpos_address, scene.base.dof_address
        moved = path[QPOS][..., q : q + 3].diff(dim=1)
        bound = float(trial.model.training_range.speed[v])
        seconds = scene.control_step * (steps // KEPT)
        beyond = norm(moved) - (1.0 + ROUNDING) * bound * seconds
        metrics[LEAP] = float(beyond.clamp(min=0.0).amax())
    return metrics
