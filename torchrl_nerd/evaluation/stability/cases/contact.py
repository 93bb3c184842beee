"""Contact and joint limits: drops, rest, friction, slopes, full torque."""

import math
from typing import cast

import mujoco
import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_nerd.evaluation.rollout_error import position_errors
from torchrl_nerd.evaluation.stability.case import (
    Metrics,
    Trial,
    hard_case,
    has_floating_base,
    has_motors,
    largest,
    norm,
)
from torchrl_nerd.evaluation.stability.states import rotated, with_rotated_ground
from torchrl_nerd.evaluation.traces import mechanics
from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.contact_points import ground_geoms
from torchrl_nerd.scenes.terrain import PLANE

HEIGHTS = (0.1, 0.3, 1.0, 3.0, 10.0)  # m
LOW, HIGH = "lowest height below MuJoCo's, m", "rise above the start, m"
DRIFT, TURN = "drift, mm/s", "rotation, mrad/s"
PENETRATION = "penetration, m"
SPEED_LEFT = "speed after 300 steps, m/s"
SLOPES = {
    share: f"speed error after 1 s on a slope of tan = {share} mu, m/s"
    for share in (0.95, 1.05)
}
EXCEEDED = "limit exceeded by more than in MuJoCo, rad or m"
PERTURBATION, NUM_PERTURBED = 1e-2, 4  # m/s and rad/s: a model's own error of a step


@hard_case({LOW: 0.05, HIGH: 0.02}, {LOW: 1e-9, HIGH: 1e-3}, has_floating_base)
def drop(trial: Trial) -> Metrics:
    """Dropped from up to 10 m it lands, does not penetrate and never rises higher."""
    z = trial.scene.base.qpos_address + 2
    lying = trial.settled(16)
    start = cast(TensorDict, lying[torch.zeros(len(HEIGHTS), dtype=torch.long)])
    start[QPOS][:, z] += torch.tensor(HEIGHTS, dtype=torch.float64)
    steppers = (trial.stepper, trial.ground_truth)
    height, exact = (s.roll(start, 300)[QPOS][..., z] for s in steppers)
    return {
        LOW: largest(exact.amin(1) - height.amin(1)),
        HIGH: largest((height[:, 1:] - height[:, :1]).amax(1)),
        "final height error, m": largest((height[:, -1] - exact[:, -1]).abs()),
    }


@hard_case({DRIFT: 1.0, TURN: 1.0, PENETRATION: 0.02}, applies=has_floating_base)
def resting(trial: Trial) -> Metrics:
    """Started where MuJoCo came to rest it stays there, on the ground and not in it."""
    scene, start, kept = trial.scene, trial.settled(16), 100
    steps = trial.scaled(10_000, kept)
    path = trial.roll(start, steps, every=steps // kept)
    here = path[QPOS]
    errors = position_errors(scene, here[:, :1].expand_as(here), here)
    seconds = scene.control_step * steps
    return {
        DRIFT: 1e3 * largest(errors["base_position"][:, -1]) / seconds,
        TURN: 1e3 * largest(errors["base_orientation"][:, -1]) / seconds,
        PENETRATION: largest(mechanics(scene, path.flatten())["penetration"]),
    }


@hard_case({SPEED_LEFT: 0.1}, {SPEED_LEFT: 0.02}, has_floating_base)
def sliding(trial: Trial) -> Metrics:
    """Pushed along the ground at 1 m/s it stops."""
    start = trial.settled(16)
    v, q = trial.scene.base.dof_address, trial.scene.base.qpos_address
    push = trial.normal(len(start), 2)
    start[QVEL][:, v : v + 2] = push / norm(push)[:, None]  # 1 m/s
    steppers = (trial.stepper, trial.ground_truth)
    end, exact = (cast(TensorDict, s.roll(start, 300)[:, -1]) for s in steppers)
    gap = norm((end[QPOS] - exact[QPOS])[:, q : q + 2])
    return {
        SPEED_LEFT: largest(norm(end[QVEL][:, v : v + 3])),
        "mean error of the stopping point, m": float(gap.mean()),
    }


def _friction(scene: Scene) -> float:
    """Coefficient between block and ground, as MuJoCo combines the two."""
    model, ground = scene.model, ground_geoms(scene.model)[0]
    block = (model.geom_bodyid > 0).nonzero()[0][0]
    first, second = model.geom_priority[[ground, block]]
    both = model.geom_friction[[ground, block], 0]
    return float(both.max() if first == second else both[int(second > first)])


def _is_block_on_plane(scene: Scene) -> bool:
    """One free block over one plane, on which it slides sooner than it topples."""
    free = int(mujoco.mjtJoint.mjJNT_FREE)
    is_block = scene.model.njnt == 1 and scene.model.jnt_type[0] == free
    kinds = [] if scene.terrain is None else [s.kind for s in scene.terrain.surfaces]
    return bool(is_block and kinds == [PLANE] and _friction(scene) < 0.5)


@hard_case(
    dict.fromkeys(SLOPES.values(), 0.02), applies=_is_block_on_plane, needs="dynamics"
)
def slope(trial: Trial) -> Metrics:
    """Friction holds a block up to its angle and no farther: Coulomb's law."""
    scene, start, stepper = trial.scene, trial.settled(16), trial.dynamics
    gravity = float(norm(torch.from_numpy(scene.model.opt.gravity.copy())))
    friction, metrics = _friction(scene), {}
    for share, name in SLOPES.items():
        angle = math.atan(share * friction)
        half = [math.cos(angle / 2.0), 0.0, math.sin(angle / 2.0), 0.0]
        quat = torch.tensor(half, dtype=torch.float64)
        if scene.terrain is not None and not scene.terrain.is_per_row:
            try:
                stepper = trial.dynamics.in_scene(with_rotated_ground(scene, quat))
            except RuntimeError:  # learned on level ground, whose normal is no feature
                metrics[name] = math.nan
                continue
        steps = round(1.0 / scene.control_step)
        end = stepper.roll(rotated(scene, start, quat), steps)[QVEL][:, -1]
        # speed after 1 s, m/s
        slide = gravity * (math.sin(angle) - friction * math.cos(angle))
        metrics[name] = largest((norm(end[:, :3]) - max(slide, 0.0)).abs())
    return metrics


def _limited(scene: Scene) -> tuple[list[int], Tensor]:
    """Addresses ``(J)`` in ``qpos`` and ranges ``(J, 2)`` of limited hinges and slides."""
    model = scene.model
    scalar = (mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE)
    found = [
        joint
        for joint in range(model.njnt)
        if model.jnt_limited[joint] and model.jnt_type[joint] in scalar
    ]
    return model.jnt_qposadr[found].tolist(), torch.from_numpy(model.jnt_range[found])


def _has_driven_limits(scene: Scene) -> bool:
    return bool(_limited(scene)[0]) and has_motors(scene)


@hard_case({EXCEEDED: 0.2}, {EXCEEDED: 1e-9}, _has_driven_limits)
def joint_limits(trial: Trial) -> Metrics:
    """Full torque presses no joint farther beyond its limit than in MuJoCo."""
    scene, start = trial.scene, trial.starts(16)
    addresses, ranges = _limited(scene)
    high = torch.tensor(scene.sampling.torque, dtype=torch.float64)
    torque = trial.normal(16, 1, len(high)).sign() * high

    def exceeded(path: TensorDict) -> Tensor:
        """How far beyond its limit each joint went, ``(n, joints)``."""
        position = cast(Tensor, path[QPOS])[..., addresses]
        low, high = ranges.unbind(-1)
        beyond = torch.maximum(low - position, position - high)
        return beyond.amax(1).clamp(min=0.0)

    own, exact = exceeded(trial.roll(start, 200, torque)), []
    for size in (0.0, *[PERTURBATION] * NUM_PERTURBED):
        nearby = start.clone()
        nearby[QVEL] += size * trial.normal(*nearby[QVEL].shape)
        exact.append(exceeded(trial.ground_truth.roll(nearby, 200, torque)))
    name = "limit exceeded in MuJoCo, rad or m"
    return {
        EXCEEDED: largest(own - torch.stack(exact).amax(0)),
        name: largest(exact[0]),
    }
