"""Inputs unlike those of training: are they detected, and does MuJoCo take over?"""

from collections.abc import Iterator
from typing import cast

import torch
from tensordict import TensorDict
from torch import Generator, Tensor

from torchrl_nerd.data.simulate import is_sound, simulate
from torchrl_nerd.dynamics import (
    Dynamics,
    GuardedDynamics,
    MujocoDynamics,
    NeRDDynamics,
)
from torchrl_nerd.evaluation.position_error import position_errors
from torchrl_nerd.evaluation.rollout_error import open_loop
from torchrl_nerd.evaluation.stability.case import Metric, Trial, hard_case
from torchrl_nerd.keys import QPOS, QVEL, TERRAIN
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.commands import command_key, command_of, drive, drive_of, idle

COUNT, LENGTH, STEPS, DRIVEN = 200, 40, 60, 5
FASTEST = 4.0  # speeds and torques relative to those of training, at most
FALSE_ALARMS = 0.01


@hard_case(needs_model=True)
def out_of_distribution(trial: Trial) -> Iterator[Metric]:
    """Inputs unlike those of training are detected, and MuJoCo can step them."""
    model = trial.model
    inside, calibration, outside = inputs(trial.scene, trial.generator)
    alarms = ood_scores(model, inside)[0] > 1.0
    threshold = torch.quantile(ood_scores(model, calibration)[0], 1.0 - FALSE_ALARMS)
    score, is_outside = ood_scores(model, outside)
    unseen = cast(TensorDict, outside[is_outside])[:COUNT]
    plain = NeRDDynamics(model)
    guarded = GuardedDynamics(NeRDDynamics(model), "fallback")
    base = _rollout_error(plain, inside[:COUNT])
    missed = float((score[is_outside] <= threshold).double().mean())
    name = "undetected inputs outside the training range at 1% false alarms, fraction"
    yield Metric(name, missed, 0.05)
    rate = float(alarms.double().mean())
    yield Metric("false alarms at the model's threshold, fraction", rate)
    name = "error outside the training range {}, relative to inside"
    error = _rollout_error(guarded, unseen) / base
    yield Metric(name.format("with fallback"), error, 2.0)
    error = _rollout_error(plain, unseen) / base
    yield Metric(name.format("without guard"), error)


def inputs(
    scene: Scene, generator: Generator
) -> tuple[TensorDict, TensorDict, TensorDict]:
    """Three sets of transitions: two like those of training, one unlike them."""
    data = simulate(scene, COUNT, LENGTH, generator)
    data = cast(TensorDict, data[is_sound(data)].flatten(0, 1))  # [transitions]
    order = torch.randperm(len(data), generator=generator)
    inside, calibration, outside = cast(TensorDict, data[order]).chunk(3)
    outside = outside.clone()
    factor = 1.0 + (FASTEST - 1.0) * torch.rand(len(outside), 1, generator=generator)
    kind = torch.randint(3, (len(outside), 1), generator=generator)
    for unscaled, key in enumerate((QVEL, command_key(scene))):  # kind 2 scales both
        value = outside[key]
        outside[key] = torch.where(kind == unscaled, value, factor.double() * value)
    return inside, calibration, outside


@torch.no_grad()
def ood_scores(model: NeRD, data: TensorDict) -> tuple[Tensor, Tensor]:
    """Of inputs ``[n]``: their score, and whether a feature is outside the range."""
    data = data.to(model.device)
    state, command = (data[QPOS], data[QVEL]), command_of(model.scene, data)
    driven = drive_of(*drive(model.scene, command, *state))
    features = model.encode(*state, driven, data.get(TERRAIN, None))[0]
    is_outside = model.training_range.excess(features) > 0.0
    return model.ood_score(features).cpu(), is_outside.cpu()


def _rollout_error(dynamics: Dynamics, start: TensorDict) -> float:
    """Median over trajectories of the mean position error, m and rad.

    Commands are held for some steps, then idle: states return to the training range.
    """
    scene = dynamics.scene
    command = command_of(scene, start)[:, None].repeat(1, STEPS, 1)  # (n, STEPS, m)
    command[:, DRIVEN:] = idle(scene, 1)
    start = start.select(QPOS, QVEL, TERRAIN, strict=False).clone()
    both = MujocoDynamics(scene), dynamics
    paths = [open_loop(one, start, STEPS, command) for one in both]
    errors = position_errors(scene, *paths)  # (n, STEPS) each
    mean = torch.stack(list(errors.values())).mean((0, 2))  # (n,)
    is_known = paths[0].isfinite().all(-1).all(-1)  # MuJoCo itself did not diverge
    return float(mean[is_known].nan_to_num(nan=torch.inf).median())
