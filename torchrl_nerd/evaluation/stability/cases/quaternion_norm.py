"""A million integrations of a turning body."""

import torch
from torch import Generator, Tensor

from torchrl_nerd.evaluation.stability.case import Case, Figures
from torchrl_nerd.evaluation.stability.measures import largest, length
from torchrl_nerd.evaluation.stability.states import starts
from torchrl_nerd.evaluation.stability.world import World
from torchrl_nerd.geometry.manifold import integrate_pos
from torchrl_nerd.keys import QPOS, QVEL

STEPS = 1_000_000
OFF = "norm off one after 1,000,000 integrations"


def _run(world: World, generator: Generator, scale: float) -> Figures:
    scene = world.scene
    start = starts(scene, 1, generator)
    qpos: Tensor = start[QPOS]
    step: Tensor = start[QVEL] * scene.control_step
    for _ in range(max(100, round(scale * STEPS))):
        qpos = integrate_pos(scene.layout, qpos, step)
    off = [length(qpos[:, q : q + 4]) - 1.0 for q, _ in scene.layout.rotations]
    return {OFF: largest(torch.stack(off).abs())}


CASE = Case(
    "quaternion_norm",
    "an orientation stays one however often it is integrated",
    _run,
    lambda scene: bool(scene.layout.rotations),
    true_lines={OFF: 1e-12},
    lines={OFF: 1e-12},
)
