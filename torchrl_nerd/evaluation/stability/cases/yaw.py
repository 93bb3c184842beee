"""The same motion in any direction."""

import torch
from tensordict import TensorDict
from torch import Generator, Tensor

from torchrl_nerd.evaluation.stability.case import Case, Figures
from torchrl_nerd.evaluation.stability.cases.translation import applies
from torchrl_nerd.evaluation.stability.measures import apart, largest
from torchrl_nerd.evaluation.stability.states import starts
from torchrl_nerd.evaluation.stability.world import World
from torchrl_nerd.geometry.frames import quat_multiply, rotate
from torchrl_nerd.keys import QPOS, QVEL

ROWS, STEPS = 16, 10
APART = "apart after 10 steps, m or rad"


def _run(world: World, generator: Generator, scale: float) -> Figures:
    scene = world.scene
    q, v = scene.base.qpos_address, scene.base.dof_address
    start = starts(scene, ROWS, generator)
    half = torch.pi * torch.rand(ROWS, 1, generator=generator).double()
    zero = torch.zeros_like(half)
    turn = torch.cat((half.cos(), zero, zero, half.sin()), -1)
    here = _turned(world.roll(start, STEPS), turn, q, v)
    there = world.roll(_turned(start[:, None], turn, q, v)[:, 0], STEPS)
    worst = apart(scene, here[QPOS], there[QPOS]).amax(1)
    return {APART: float(worst.median()), "worst row": largest(worst)}


def _turned(states: TensorDict, turn: Tensor, q: int, v: int) -> TensorDict:
    """States ``[rows, T]`` turned about the vertical through the origin."""
    states, turn = states.clone(), turn[:, None].expand(*states.batch_size, 4)
    qpos, qvel = states[QPOS], states[QVEL]
    qpos[..., q : q + 3] = rotate(turn, qpos[..., q : q + 3])
    qpos[..., q + 3 : q + 7] = quat_multiply(turn, qpos[..., q + 3 : q + 7])
    qvel[..., v : v + 3] = rotate(turn, qvel[..., v : v + 3])
    return states


CASE = Case(
    "yaw",
    "level ground is the same in every direction; MuJoCo's friction is a cone in all of "
    "them, so the true motion turns along too",
    _run,
    applies,
    true_lines={APART: 1e-4},
    lines={APART: 1e-4},
)
