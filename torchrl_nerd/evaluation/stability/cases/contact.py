"""Contact: drops, rest, friction, slopes, stiffness, and the margin of the features."""

import copy
import math
from dataclasses import replace
from typing import cast

import mujoco
import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_nerd.dynamics import (
    AnalyticDynamics,
    MujocoDynamics,
    NeRDDynamics,
    dynamics_of,
)
from torchrl_nerd.evaluation.rollout_error import position_errors
from torchrl_nerd.evaluation.stability.case import (
    Metrics,
    Trial,
    hard_case,
    has_floating_base,
)
from torchrl_nerd.evaluation.stability.measures import (
    largest,
    mechanics,
    norm,
)
from torchrl_nerd.evaluation.stability.states import (
    rotated,
    with_rotated_ground,
)
from torchrl_nerd.evaluation.stability.stepper import DynamicsStepper, Stepper
from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.contact_points import ground_geoms
from torchrl_nerd.scenes.terrain import PLANE
from torchrl_nerd.transforms import ContactFeatures

HEIGHTS = (0.1, 0.3, 1.0, 3.0, 10.0)  # m
LOW, HIGH = "lowest height below MuJoCo's, m", "rise above the start, m"
DRIFT, TURN = "drift, mm/s", "rotation, mrad/s"
PENETRATION = "penetration, m"
SPEED_LEFT = "speed after 300 steps, m/s"
ABOVE = 1e-7  # m to either side of the margin
FEATURE_JUMP, STATE_JUMP = "jump of a feature, m or m/s", "jump of the next state"
STIFFER = 4.0
FARTHEST = "largest error against the stiffer ground, m or rad"
SLOPES = {
    share: f"speed error after 1 s on a slope of tan = {share} mu, m/s"
    for share in (0.95, 1.05)
}


@hard_case(has_floating_base, {LOW: 0.05, HIGH: 0.02}, {LOW: 1e-9, HIGH: 1e-3})
def drop(trial: Trial) -> Metrics:
    """Dropped from up to 10 m it lands, does not penetrate and never rises higher."""
    z = trial.scene.base.qpos_address + 2
    lying = trial.settled(16)
    start = cast(TensorDict, lying[torch.zeros(len(HEIGHTS), dtype=torch.long)])
    start[QPOS][:, z] += torch.tensor(HEIGHTS, dtype=torch.float64)
    steppers = (trial.stepper, trial.ground_truth)
    height, exact = (s.roll(start, 300)[QPOS][..., z] for s in steppers)
    end = (height[:, -1] - exact[:, -1]).abs().tolist()
    return {
        LOW: largest(exact.amin(1) - height.amin(1)),
        HIGH: largest((height[:, 1:] - height[:, :1]).amax(1)),
        **{
            f"final height error, dropped from {above:g} m, m": error
            for above, error in zip(HEIGHTS, end, strict=True)
        },
    }


@hard_case(has_floating_base, {DRIFT: 1.0, TURN: 1.0, PENETRATION: 0.02})
def resting(trial: Trial) -> Metrics:
    """Started where MuJoCo came to rest it stays there, on the ground and not in it."""
    scene, start, kept = trial.scene, trial.settled(16), 100
    steps = trial.scaled(10_000, kept)
    path = trial.roll(start, steps, every=steps // kept)
    here = path[QPOS]
    errors = position_errors(scene, here[:, :1].expand_as(here), here)
    seconds = scene.control_step * steps
    depth = torch.from_numpy(mechanics(scene, path.flatten())["penetration"])
    return {
        DRIFT: 1e3 * largest(errors["base_position"][:, -1]) / seconds,
        TURN: 1e3 * largest(errors["base_orientation"][:, -1]) / seconds,
        PENETRATION: largest(depth),
        "largest distance from the start, m": largest(errors["base_position"]),
    }


@hard_case(has_floating_base, {SPEED_LEFT: 0.1}, {SPEED_LEFT: 0.02})
def sliding(trial: Trial) -> Metrics:
    """Pushed along the ground at 1 m/s it stops."""
    start = trial.settled(16)
    v, q = trial.scene.base.dof_address, trial.scene.base.qpos_address
    angle = 2.0 * torch.pi * trial.uniform(len(start))
    start[QVEL][:, v : v + 2] = torch.stack((angle.cos(), angle.sin()), -1)  # 1 m/s
    steppers = (trial.stepper, trial.ground_truth)
    end, exact = (cast(TensorDict, s.roll(start, 300)[:, -1]) for s in steppers)
    here, there, origin = (x[QPOS][:, q : q + 2] for x in (end, exact, start))
    return {
        SPEED_LEFT: largest(norm(end[QVEL][:, v : v + 3])),
        "mean error of the stopping point, m": float(norm(here - there).mean()),
        "mean stopping distance in MuJoCo, m": float(norm(there - origin).mean()),
    }


@hard_case(
    has_floating_base,
    {FEATURE_JUMP: 1e-5, STATE_JUMP: 1e-3},
    {FEATURE_JUMP: 1e-5, STATE_JUMP: 1e-5},
)
def margin(trial: Trial) -> Metrics:
    """Features of a point that comes near begin gradually: nothing jumps."""
    rest, z = trial.settled(16), trial.scene.base.qpos_address + 2
    module = ContactFeatures(trial.scene)

    def lifted(height: Tensor) -> TensorDict:
        state = rest.clone()
        state[QPOS][:, z] += height
        return state

    def features(state: TensorDict) -> list[Tensor]:
        return module.contact_features(state[QPOS], state[QVEL])

    low = torch.zeros(len(rest), dtype=torch.float64)
    high = low + 3.0
    for _ in range(60):  # bisection: where the last point leaves its margin
        middle = 0.5 * (low + high)
        is_near = (features(lifted(middle))[0] < 0.0).any(-1)
        low = torch.where(is_near, middle, low)
        high = torch.where(is_near, high, middle)
    sides = [lifted(low - ABOVE), lifted(high + ABOVE)]
    seen = [torch.cat(features(side), -1) for side in sides]
    ends = [cast(TensorDict, trial.roll(side, 1)[:, -1]) for side in sides]
    states = [torch.cat((end[QPOS], end[QVEL]), -1) for end in ends]
    return {
        FEATURE_JUMP: largest((seen[0] - seen[1]).abs()),
        STATE_JUMP: largest((states[0] - states[1]).abs()),
    }


@hard_case(lambda scene: scene.terrain is not None, {FARTHEST: 1e3})
def stiff_contact(trial: Trial) -> Metrics:
    """Ground four times as stiff as the one that was learned makes nothing diverge."""
    scene, start = trial.scene, trial.starts(32)
    stiff = DynamicsStepper(MujocoDynamics(_with_stiffness(scene, STIFFER)))
    steppers = (trial.stepper, trial.ground_truth, stiff)
    mine, plain, expected = (s.roll(start, 60) for s in steppers)
    error = trial.difference(expected, mine)
    own, change = (trial.difference(plain, x).mean() for x in (mine, expected))
    return {
        "mean error against the stiffer ground, m or rad": float(error.mean()),
        "mean error against the scene's own ground, m or rad": float(own),
        "mean difference between the two in MuJoCo, m or rad": float(change),
        FARTHEST: largest(error),
    }


def _with_stiffness(scene: Scene, factor: float) -> Scene:
    """The scene with contacts ``factor`` times as stiff and the same damping ratio.

    MuJoCo's stiffness goes with the inverse square of a contact's time constant, which it
    keeps at two timesteps or more.
    """
    model = copy.copy(scene.model)
    is_time = model.geom_solref[:, 0] > 0.0  # else stiffness and damping themselves
    model.geom_solref[is_time, 0] /= factor**0.5
    model.geom_solref[~is_time, 0] *= factor
    model.geom_solref[~is_time, 1] *= factor**0.5
    return replace(scene, model=model)


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


@hard_case(_is_block_on_plane, dict.fromkeys(SLOPES.values(), 0.02), needs="dynamics")
def slope(trial: Trial) -> Metrics:
    """Friction holds a block up to its angle and no farther: Coulomb's law."""
    scene, start = trial.scene, trial.settled(16)
    gravity = float(torch.from_numpy(scene.model.opt.gravity.copy()).norm())
    friction, metrics = _friction(scene), {}
    for share, name in SLOPES.items():
        angle = math.atan(share * friction)
        half = [math.cos(angle / 2.0), 0.0, math.sin(angle / 2.0), 0.0]
        quat = torch.tensor(half, dtype=torch.float64)
        try:
            stepper = _on_slope(trial.stepper, quat)
        except ValueError:  # learned on level ground, whose normal is no feature
            metrics[name] = math.nan
            continue
        steps = round(1.0 / scene.control_step)
        end = stepper.roll(rotated(scene, start, quat), steps)[QVEL][:, -1]
        slide = gravity * (
            math.sin(angle) - friction * math.cos(angle)
        )  # m/s after 1 s
        metrics[name] = largest((norm(end[:, :3]) - max(slide, 0.0)).abs())
    return metrics


def _on_slope(stepper: Stepper, quat: Tensor) -> Stepper:
    """The same dynamics on rotated ground; a ground per trajectory is in the state.

    Raises:
        ValueError: a model that was trained on another kind of ground.
    """
    terrain = stepper.scene.terrain
    if terrain is not None and terrain.is_per_row:
        return stepper
    scene = with_rotated_ground(stepper.scene, quat)
    dynamics = stepper.dynamics
    if isinstance(dynamics, AnalyticDynamics):
        model = dynamics.analytic_step.with_terrain(scene)
    elif isinstance(dynamics, NeRDDynamics):
        model = dynamics.model.with_terrain(scene)
    else:
        return DynamicsStepper(MujocoDynamics(scene))
    return DynamicsStepper(dynamics_of(model))
