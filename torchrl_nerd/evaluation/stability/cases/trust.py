"""Does the trust gate know what the model does not?"""

from typing import cast

import torch
from scipy.stats import mannwhitneyu
from tensordict import TensorDict
from torch import Generator, Tensor

from torchrl_nerd.data.generate import is_sound, simulate
from torchrl_nerd.dynamics import GuardedDynamics, MujocoDynamics, NeRDDynamics
from torchrl_nerd.evaluation.rollout_error import open_loop_errors
from torchrl_nerd.evaluation.stability.case import Case, Figures
from torchrl_nerd.evaluation.stability.world import World
from torchrl_nerd.keys import JOINT_TORQUE, QPOS, QVEL, TERRAIN
from torchrl_nerd.modules.nerd import TARGET, NeRD
from torchrl_nerd.scenes import Scene

ROWS, LENGTH, STEPS, DRIVEN = 200, 40, 60, 5
FASTEST = 4.0  # speeds and torques beyond the training range, times
FALSE_ALARMS = 0.01
MISSED = "rows outside the training range not caught at 1% false alarms, share"
RATIO = "error with fallback outside the range, of that inside"


def _run(world: World, generator: Generator, scale: float) -> Figures:
    learned = world.dynamics
    if not isinstance(learned, NeRDDynamics):
        return {MISSED: 0.0, RATIO: 1.0}  # MuJoCo needs no guard
    scene, model = world.scene, learned.model
    inside, calibration, outside = inputs(scene, generator)
    seen, known, unseen = (scores(model, d) for d in (inside, calibration, outside))
    level = torch.quantile(known["distance"], 1.0 - FALSE_ALARMS)
    beyond = unseen["excess"] > 0.0
    large = torch.quantile(known["error"], 0.99)
    wrong = torch.cat([x["error"] > large for x in (seen, unseen)])
    figures = {
        MISSED: float((unseen["distance"][beyond] <= level).double().mean()),
        "false alarms at the shipped level, share": float(
            (seen["distance"] > 1.0).double().mean()
        ),
    }
    for name in ("distance", "mahalanobis", "excess"):
        score = torch.cat([x[name] for x in (seen, unseen)])
        figures[f"area under ROC of {name}, large errors"] = auc(score, wrong)
    guarded = GuardedDynamics(NeRDDynamics(model), "fallback")
    rows = beyond.nonzero()[:ROWS, 0]
    errors = [
        _rollout_error(dynamics, part)
        for dynamics, part in (
            (guarded, outside[rows]),
            (NeRDDynamics(model), inside[:ROWS]),
            (NeRDDynamics(model), outside[rows]),
        )
    ]
    figures[RATIO] = errors[0] / errors[1]
    figures["the same without a guard"] = errors[2] / errors[1]
    return figures


def inputs(
    scene: Scene, generator: Generator
) -> tuple[TensorDict, TensorDict, TensorDict]:
    """Three times as many transitions: two like those of training, one unlike them."""
    data = simulate(scene, ROWS, LENGTH, generator)
    data = cast(TensorDict, data[is_sound(data)].flatten(0, 1))
    order = torch.randperm(len(data), generator=generator)
    inside, calibration, outside = cast(TensorDict, data[order]).chunk(3)
    return inside, calibration, stretched(outside.clone(), generator)


def stretched(data: TensorDict, generator: Generator) -> TensorDict:
    """Speeds, torques or both up to `FASTEST` times as large."""
    factor = 1.0 + (FASTEST - 1.0) * torch.rand(len(data), 1, generator=generator)
    kind = torch.randint(3, (len(data), 1), generator=generator)
    data[QVEL] = torch.where(kind == 0, data[QVEL], factor.double() * data[QVEL])
    torque = data[JOINT_TORQUE]
    data[JOINT_TORQUE] = torch.where(kind == 1, torque, factor.double() * torque)
    return data


def scores(model: NeRD, data: TensorDict, **others: Tensor) -> dict[str, Tensor]:
    """Scores of inputs, and the normalised one-step errors that they should foretell.

    Rows that MuJoCo gives up on are left out, of other scores ``(rows,)`` too.
    """
    data = data.to(model.device)
    terrain, torque = data.get(TERRAIN, None), data[JOINT_TORQUE]
    now = data[QPOS], data[QVEL]
    after = MujocoDynamics(model.scene).step(data, torque, terrain)
    fine = torch.all(after[QVEL].isfinite(), -1)
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
    return {name: score[fine].cpu() for name, score in found.items()}


def auc(score: Tensor, is_large: Tensor) -> float:
    """Share of pairs of a large and a small error that the score puts in order.

    A tie counts as half a pair, as in Mann and Whitney's statistic.
    """
    large, small = (score[rows].numpy() for rows in (is_large, ~is_large))
    if not len(large) or not len(small):
        return float("nan")
    return float(mannwhitneyu(large, small).statistic / (len(large) * len(small)))


def _rollout_error(
    dynamics: NeRDDynamics | GuardedDynamics, start: TensorDict
) -> float:
    """Median over rows of the mean position error, m and rad.

    Torques are held for some steps, then let go: rows come back into the training range.
    """
    torque = start.get(JOINT_TORQUE)[:, None].repeat(1, STEPS, 1)
    torque[:, DRIVEN:] = 0.0
    start = start.select(QPOS, QVEL, TERRAIN, strict=False).clone()
    truth = MujocoDynamics(dynamics.scene)
    errors = open_loop_errors(truth, dynamics, start, STEPS, torque)
    return float(torch.stack(list(errors.values())).mean((0, 2)).nanmedian())


CASE = Case(
    "trust",
    "inputs unlike those of training are told apart, and MuJoCo takes over for them",
    _run,
    lines={MISSED: 0.05, RATIO: 2.0},
    needs_dynamics=True,
)
