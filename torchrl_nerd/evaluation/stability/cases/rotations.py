"""Turns from a millionth of a millionth of a radian to a half turn, there and back."""

import math

import torch
from torch import Generator

from torchrl_nerd.evaluation.stability.case import Case, Figures
from torchrl_nerd.evaluation.stability.measures import largest
from torchrl_nerd.evaluation.stability.states import starts
from torchrl_nerd.evaluation.stability.world import World
from torchrl_nerd.geometry.rotations import quat_exp, quat_multiply
from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.transforms import StateDelta

ANGLES = (1e-12, 1e-8, 1e-4, 1.0, 3.0, math.pi - 1e-9, math.pi)
BACK = "next state after there and back"


def _run(world: World, generator: Generator, scale: float) -> Figures:
    scene = world.scene
    layout, delta = scene.layout, StateDelta(scene)
    start = starts(scene, len(ANGLES), generator)
    after = start.clone()
    angle = torch.tensor(ANGLES, dtype=torch.float64)[:, None]
    for q, _ in layout.rotations:
        axis = torch.randn(len(ANGLES), 3, generator=generator, dtype=torch.float64)
        axis = axis / axis.norm(dim=-1, keepdim=True)
        quat = after[QPOS][:, q : q + 4]
        after[QPOS][:, q : q + 4] = quat_multiply(quat, quat_exp(angle * axis))
    now, then = (start[QPOS], start[QVEL]), (after[QPOS], after[QVEL])
    qpos, qvel = delta.integrate(*now, delta.delta(*now, *then))
    error = (qvel - then[1]).abs().amax()
    for q, _ in layout.rotations:  # either sign of a quaternion will do
        dot = (qpos[:, q : q + 4] * then[0][:, q : q + 4]).sum(-1).abs()
        error = torch.maximum(error, (1.0 - dot).abs().amax())
    return {BACK: largest(error)}


CASE = Case(
    "rotations",
    "the change between two states, integrated, gives the second one at any angle",
    _run,
    lambda scene: bool(scene.layout.rotations),
    true_lines={BACK: 1e-9},
    lines={BACK: 1e-9},
)
