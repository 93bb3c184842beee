"""The centre of mass of a free robot in the air against the closed form."""

import numpy as np
import torch
from torch import Generator

from torchrl_nerd.evaluation.stability.case import Case, Figures, has_floating_base
from torchrl_nerd.evaluation.stability.flight import STEPS, quiet_flight
from torchrl_nerd.evaluation.stability.measures import largest
from torchrl_nerd.evaluation.stability.world import World

MISS = "miss after half a second, m"


def _run(world: World, generator: Generator, scale: float) -> Figures:
    scene = world.scene
    found = quiet_flight(world, generator)
    com, mass = found["com"], scene.model.body_mass.sum()
    velocity = found["momentum"][:, 0] / mass
    time = scene.control_step * np.arange(STEPS + 1)[:, None]
    gravity = scene.model.opt.gravity
    # MuJoCo's semi-implicit Euler falls half a substep's worth farther
    late = time + scene.model.opt.timestep
    parabola = com[:, :1] + velocity[:, None] * time + 0.5 * gravity * time * late
    miss = torch.from_numpy(com - parabola).norm(dim=-1)
    return {MISS: largest(miss.mean(0)), "worst row, m": largest(miss)}


CASE = Case(
    "free_fall",
    "the centre of mass flies along a parabola",
    _run,
    has_floating_base,
    true_lines={MISS: 1e-3},
    lines={MISS: 0.02},
)
