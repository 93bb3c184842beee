"""How long a prediction holds, and torques that make it as bad as possible."""

import torch

from torchrl_nerd.evaluation.rollout_error import position_errors
from torchrl_nerd.evaluation.stability.case import (
    Metrics,
    Trial,
    hard_case,
    has_motors,
)
from torchrl_nerd.evaluation.stability.states import perturbed
from torchrl_nerd.keys import QPOS

PERTURBATION = 1e-6  # of every velocity
LARGE = 0.3  # m or rad: the prediction no longer holds
CANDIDATES, STEPS, ROUNDS, ELITE = 128, 20, 8, 16


@hard_case()
def sensitivity(trial: Trial) -> Metrics:
    """Nearby starts diverge at a rate of their own, which bounds every prediction."""
    scene, start = trial.scene, trial.starts(32)
    other = perturbed(start, PERTURBATION, trial.generator)
    exact, nearby = (trial.ground_truth.roll(s, 200) for s in (start, other))
    spread = trial.difference(exact, nearby)
    error = trial.difference(exact, trial.roll(start, 200))
    growth = spread[:, -1].median() / spread[:, 1].median().clamp(min=1e-15)
    rate = float(growth.log()) / (scene.control_step * 199)
    holds = (error < LARGE).long().cumprod(1).sum(1).double().mean()
    seconds = float(holds) * scene.control_step
    return {
        "time until the error exceeds 0.3, s": seconds,
        "time until the error exceeds 0.3, Lyapunov times": max(rate, 0.0) * seconds,
        "final error, m or rad": float(error[:, -1].nan_to_num(torch.inf).mean()),
        "sensitivity of MuJoCo to starts 1e-6 apart, m or rad": float(
            spread[:, -1].mean()
        ),
    }


@hard_case(has_motors)
def adversary(trial: Trial) -> Metrics:
    """Torques found by the cross-entropy method increase the error as a policy might."""
    scene = trial.scene
    start = trial.starts(1)[torch.zeros(CANDIDATES, dtype=torch.long)].clone()
    high = torch.tensor(scene.sampling.torque, dtype=torch.float64)
    torque = trial.torques(CANDIDATES, STEPS)
    scores = []
    for _ in range(trial.scaled(ROUNDS, 2)):
        steppers = (trial.ground_truth, trial.stepper)
        paths = [stepper.roll(start, STEPS, torque)[QPOS] for stepper in steppers]
        errors = position_errors(scene, *paths).values()
        scores.append(torch.stack([e.mean(1) for e in errors]).amax(0).nan_to_num(0.0))
        best = torque[scores[-1].topk(ELITE).indices]
        torque = best.mean(0) + best.std(0) * trial.normal(*torque.shape)
        torque = torque.clamp(-high, high)
    return {
        "mean error of random torques, m or rad": float(scores[0].mean()),
        "largest error of 128 random torques, m or rad": float(scores[0].max()),
        "largest error found by the search, m or rad": float(scores[-1].max()),
    }
