"""Inputs unlike those of training: are they detected, and does MuJoCo take over?"""

from typing import cast

import torch
from scipy.stats import mannwhitneyu
from tensordict import TensorDict
from torch import Generator, Tensor

from torchrl_nerd.data.simulate import is_sound, simulate
from torchrl_nerd.dynamics import GuardedDynamics, MujocoDynamics, NeRDDynamics
from torchrl_nerd.evaluation.rollout_error import open_loop_errors
from torchrl_nerd.evaluation.stability.case import Metrics, Trial, hard_case
from torchrl_nerd.keys import JOINT_TORQUE, QPOS, QVEL, TERRAIN
from torchrl_nerd.modules.nerd import TARGET, NeRD
from torchrl_nerd.scenes import Scene

COUNT, LENGTH, STEPS, DRIVEN = 200, 40, 60, 5
FASTEST = 4.0  # speeds and torques relative to those of training, at most
FALSE_ALARMS = 0.01
MISSED = "undetected inputs outside the training range at 1% false alarms, fraction"
RATIO = "error outside the training range with fallback, relative to inside"


@hard_case(tolerances={MISSED: 0.05, RATIO: 2.0}, needs="model")
def out_of_distribution(trial: Trial) -> Metrics:
    """Inputs unlike those of training are detected, and MuJoCo can step them."""
    model = trial.model
    inside, calibration, outside = inputs(trial.scene, trial.generator)
    seen, known, unseen = (scores(model, d) for d in (inside, calibration, outside))
    threshold = torch.quantile(known["distance"], 1.0 - FALSE_ALARMS)
    is_outside = unseen["excess"] > 0.0
    large = torch.quantile(known["error"], 0.99)
    is_large = torch.cat([x["error"] > large for x in (seen, unseen)])
    missed = (unseen["distance"][is_outside] <= threshold).double().mean()
    alarms = (seen["distance"] > 1.0).double().mean()
    metrics = {
        MISSED: float(missed),
        "false alarms at the model's threshold, fraction": float(alarms),
    }
    for name in ("distance", "mahalanobis", "excess"):
        score = torch.cat([x[name] for x in (seen, unseen)])
        metrics[f"ROC AUC of {name} for large errors"] = auc(score, is_large)
    plain, chosen = NeRDDynamics(model), is_outside.nonzero()[:COUNT, 0]
    guarded = GuardedDynamics(NeRDDynamics(model), "fallback")
    base = _rollout_error(plain, inside[:COUNT])
    metrics[RATIO] = _rollout_error(guarded, outside[chosen]) / base
    name = "error outside the training range without guard, relative to inside"
    metrics[name] = _rollout_error(plain, outside[chosen]) / base
    return metrics


def inputs(
    scene: Scene, generator: Generator
) -> tuple[TensorDict, TensorDict, TensorDict]:
    """Three sets of transitions: two like those of training, one unlike them."""
    data = simulate(scene, COUNT, LENGTH, generator)
    data = cast(TensorDict, data[is_sound(data)].flatten(0, 1))
    order = torch.randperm(len(data), generator=generator)
    inside, calibration, outside = cast(TensorDict, data[order]).chunk(3)
    outside = outside.clone()
    factor = 1.0 + (FASTEST - 1.0) * torch.rand(len(outside), 1, generator=generator)
    kind = torch.randint(3, (len(outside), 1), generator=generator)
    for unscaled, key in enumerate((QVEL, JOINT_TORQUE)):  # kind 2 scales both
        value = outside[key]
        outside[key] = torch.where(kind == unscaled, value, factor.double() * value)
    return inside, calibration, outside


def scores(model: NeRD, data: TensorDict, **others: Tensor) -> dict[str, Tensor]:
    """Scores of inputs, and the normalised one-step errors that they should predict.

    Where MuJoCo loses the state the entry is left out, of ``others (n,)`` too.
    """
    data = data.to(model.device)
    terrain, torque = data.get(TERRAIN, None), data[JOINT_TORQUE]
    now = data[QPOS], data[QVEL]
    after = MujocoDynamics(model.scene).step(data, torque, terrain)
    is_valid = torch.all(after[QVEL].isfinite(), -1)
    target = model.state_delta.delta(*now, after[QPOS], after[QVEL])
    with torch.no_grad():
        features, token, base, gate = model.encode(*now, torque, terrain)
        output = model.network.step(token, model.network.empty_memory(len(token)))
    change = base + gate * output.double()
    error = change - model.normalize.normalize(TARGET, target)
    found = {
        "error": error.square().mean(-1).sqrt(),
        "distance": model.ood_score(features),
        "mahalanobis": model.ood.mahalanobis(features),
        "excess": model.training_range.excess(features),
        **others,
    }
    return {name: score[is_valid].cpu() for name, score in found.items()}


def auc(score: Tensor, is_large: Tensor) -> float:
    """Area under the ROC curve: fraction of pairs of errors that the score orders.

    A tie counts as half a pair, as in Mann and Whitney's statistic.
    """
    large, small = (score[rows].numpy() for rows in (is_large, ~is_large))
    if not len(large) or not len(small):
        return float("nan")
    return float(mannwhitneyu(large, small).statistic / (len(large) * len(small)))


def _rollout_error(
    dynamics: NeRDDynamics | GuardedDynamics, start: TensorDict
) -> float:
    """Median over trajectories of the mean position error, m and rad.

    Torques are held for some steps, then zero: states return to the training range.
    """
    torque = start.get(JOINT_TORQUE)[:, None].repeat(1, STEPS, 1)
    torque[:, DRIVEN:] = 0.0
    start = start.select(QPOS, QVEL, TERRAIN, strict=False).clone()
    exact = MujocoDynamics(dynamics.scene)
    errors = open_loop_errors(exact, dynamics, start, STEPS, torque)
    return float(torch.stack(list(errors.values())).mean((0, 2)).nanmedian())
