"""Contact and joint limits: drops, rest, friction, full torque."""

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
from torchrl_nerd.evaluation.stability.states import mechanics
from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.scenes import Scene

HEIGHTS = (0.1, 0.3, 1.0, 3.0, 10.0)  # m
LOW, HIGH = "lowest height below MuJoCo's, m", "rise above the start, m"
DRIFT, TURN = "drift, mm/s", "rotation, mrad/s"
PENETRATION = "penetration, m"
SPEED_LEFT = "speed after 300 steps, m/s"
EXCEEDED = "limit exceeded by more than in MuJoCo, rad or m"
PERTURBATION, NUM_PERTURBED = 1e-2, 4  # m/s and rad/s: a model's own error of a step


@hard_case({LOW: 0.05, HIGH: 0.02}, {LOW: 1e-9, HIGH: 1e-3}, has_floating_base)
def drop(trial: Trial) -> Metrics:
    """Dropped from up to 10 m it lands, does not penetrate and never rises higher."""
    z = trial.scene.base.qpos_address + 2
    lying = trial.settled(16)
    # the first pose at rest, once for every height
    start = cast(TensorDict, lying[torch.zeros(len(HEIGHTS), dtype=torch.long)])
    start[QPOS][:, z] += torch.tensor(HEIGHTS, dtype=torch.float64)
    height = trial.roll(start, 300)[QPOS][..., z]  # (heights, 301)
    exact = trial.roll_exactly(start, 300)[QPOS][..., z]
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
    here = path[QPOS]  # (n, 1 + kept, nq)
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
    end = cast(TensorDict, trial.roll(start, 300)[:, -1])
    exact = cast(TensorDict, trial.roll_exactly(start, 300)[:, -1])
    gap = norm((end[QPOS] - exact[QPOS])[:, q : q + 2])
    return {
        SPEED_LEFT: largest(norm(end[QVEL][:, v : v + 3])),
        "mean error of the stopping point, m": float(gap.mean()),
    }


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
    # a trajectory near a limit may miss it: MuJoCo's nearby ones count too
    for size in (0.0, *[PERTURBATION] * NUM_PERTURBED):
        nearby = start.clone()
        nearby[QVEL] += size * trial.normal(*nearby[QVEL].shape)
        exact.append(exceeded(trial.roll_exactly(nearby, 200, torque)))
    name = "limit exceeded in MuJoCo, rad or m"
    return {
        EXCEEDED: largest(own - torch.stack(exact).amax(0)),
        name: largest(exact[0]),
    }
