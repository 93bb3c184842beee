"""Friction: a robot that slides over the ground stops."""

from typing import cast

import torch
from tensordict import TensorDict
from torch import Generator

from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.evaluation.stability.case import Case, Figures, has_floating_base
from torchrl_nerd.evaluation.stability.measures import largest, length
from torchrl_nerd.evaluation.stability.states import settled
from torchrl_nerd.evaluation.stability.world import DynamicsWorld, World
from torchrl_nerd.keys import QPOS, QVEL

ROWS, STEPS = 16, 300
SPEED = 1.0  # m/s
LEFT = "speed left after 300 steps, m/s"


def _run(world: World, generator: Generator, scale: float) -> Figures:
    scene = world.scene
    start = settled(scene, ROWS).clone()
    v, q = scene.base.dof_address, scene.base.qpos_address
    angle = 2.0 * torch.pi * torch.rand(len(start), generator=generator).double()
    start[QVEL][:, v : v + 2] = SPEED * torch.stack((angle.cos(), angle.sin()), -1)
    truth = DynamicsWorld(MujocoDynamics(scene))
    end, true = (cast(TensorDict, w.roll(start, STEPS)[:, -1]) for w in (world, truth))
    here, there = (x[QPOS][:, q : q + 2] for x in (end, true))
    way = length(there - start[QPOS][:, q : q + 2])
    return {
        LEFT: largest(length(end[QVEL][:, v : v + 3])),
        "stops beside MuJoCo, m, mean": float(length(here - there).mean()),
        "way in MuJoCo, m, mean": float(way.mean()),
    }


CASE = Case(
    "sliding",
    "pushed along the ground at 1 m/s it stops",
    _run,
    has_floating_base,
    true_lines={LEFT: 0.02},
    lines={LEFT: 0.1},
)
