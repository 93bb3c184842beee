"""Torques sought to make the learned motion as wrong as they can."""

import torch
from torch import Generator

from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.evaluation.rollout_error import position_errors
from torchrl_nerd.evaluation.stability.case import Case, Figures, has_motors
from torchrl_nerd.evaluation.stability.states import starts, uniform_torque
from torchrl_nerd.evaluation.stability.world import DynamicsWorld, World
from torchrl_nerd.keys import QPOS

ROWS, STEPS, ROUNDS, ELITE = 128, 20, 8, 16


def _run(world: World, generator: Generator, scale: float) -> Figures:
    scene = world.scene
    truth = DynamicsWorld(MujocoDynamics(scene))
    start = starts(scene, 1, generator)[torch.zeros(ROWS, dtype=torch.long)].clone()
    high = torch.tensor(scene.sampling.torque, dtype=torch.float64)
    torque = uniform_torque(scene, ROWS, STEPS, generator)
    first = last = torch.zeros(())
    for round_ in range(max(2, round(scale * ROUNDS))):  # the cross-entropy method
        paths = [w.roll(start, STEPS, torque)[QPOS] for w in (truth, world)]
        errors = position_errors(scene, *paths)
        score = (
            torch.stack([e.mean(1) for e in errors.values()]).amax(0).nan_to_num(0.0)
        )
        last = score
        first = score if round_ == 0 else first
        best = torque[score.topk(ELITE).indices]
        noise = torch.randn(torque.shape, generator=generator, dtype=torch.float64)
        torque = (best.mean(0) + best.std(0) * noise).clamp(-high, high)
    return {
        "mean error of random torques, m or rad": float(first.mean()),
        "worst of 128 random torques": float(first.max()),
        "worst that the search found": float(last.max()),
    }


CASE = Case(
    "adversary",
    "torques found by the cross-entropy method, which a policy might find too",
    _run,
    has_motors,
)
