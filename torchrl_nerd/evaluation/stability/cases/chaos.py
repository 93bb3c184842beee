"""How long a prediction holds, beside how long any could."""

import torch
from torch import Generator

from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.evaluation.stability.case import Case, Figures
from torchrl_nerd.evaluation.stability.measures import apart
from torchrl_nerd.evaluation.stability.states import nudged, starts
from torchrl_nerd.evaluation.stability.world import DynamicsWorld, World
from torchrl_nerd.keys import QPOS

ROWS, STEPS = 32, 200
NUDGE = 1e-6  # of every velocity
GONE = 0.3  # m or rad: the prediction no longer holds


def _run(world: World, generator: Generator, scale: float) -> Figures:
    truth = DynamicsWorld(MujocoDynamics(world.scene))
    start = starts(world.scene, ROWS, generator)
    beside = nudged(start, NUDGE, generator)
    true = truth.roll(start, STEPS)[QPOS]
    floor = apart(world.scene, true, truth.roll(beside, STEPS)[QPOS])
    error = apart(world.scene, true, world.roll(start, STEPS)[QPOS])
    grown = (floor[:, -1].median() / floor[:, 1].median().clamp(min=1e-15)).log()
    rate = float(grown) / (world.scene.control_step * (STEPS - 1))
    hold = (error < GONE).long().cumprod(1).sum(1).double().mean()
    seconds = float(hold) * world.scene.control_step
    return {
        "holds for, s of 200 steps": seconds,
        "Lyapunov times": max(rate, 0.0) * seconds,
        "final error, m or rad": float(error[:, -1].nan_to_num(torch.inf).mean()),
        "chaos floor of a nudge of 1e-6": float(floor[:, -1].mean()),
    }


CASE = Case(
    "chaos",
    "nearby starts part at a rate of their own; no model can hold longer than that allows",
    _run,
)
