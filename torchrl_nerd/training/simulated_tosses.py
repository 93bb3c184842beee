"""Tosses of many slightly different cubes in MuJoCo: what a model learns before real ones.

Friction, stiffness, damping, size, inertia and gravity are drawn anew for every cube, so
that what is learned holds for a cube that nobody has measured.
"""

import torch
from tensordict import TensorDict
from torch import Generator

from torchrl_nerd.data.cube_tosses import Tosses
from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.evaluation.system_identification import PUBLISHED, cube_with
from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.scenes import Scene

SPREAD = {
    "gravity": 0.03,
    "size": 0.03,
    "inertia": 0.2,
    "friction": 0.3,
    "stiffness": 0.5,
    "damping": 0.5,
    "slip": 0.5,
}
"""Half ranges of the logarithms of `system_identification.PUBLISHED`."""


def simulate_tosses(
    scene: Scene, cubes: int, tosses: int, states: int, seed: int = 0
) -> Tosses:
    """Tosses in MuJoCo from the scene's training ranges.

    Args:
        scene: of the published cube.
        cubes: how many different ones.
        tosses: of each.
        states: of each toss.
        seed: of cubes and starts.
    """
    generator = Generator().manual_seed(seed)
    qpos, qvel = [], []
    for _ in range(cubes):
        draw = 2.0 * torch.rand(len(SPREAD), generator=generator).double() - 1.0
        factors = (draw * torch.tensor(list(SPREAD.values())).double()).exp().tolist()
        drawn = dict(zip(SPREAD, factors, strict=True))
        scaled = {key: PUBLISHED[key] * factor for key, factor in drawn.items()}
        cube = cube_with(scene, {**PUBLISHED, **scaled})
        start = TensorDict(cube.sample_initial(tosses, generator)[0], [tosses])
        dynamics = MujocoDynamics(cube, num_threads=1)
        dynamics.reset(start)
        idle = torch.zeros(tosses, states - 1, 0, dtype=torch.float64)
        path = dynamics.rollout(start, idle)
        for parts, key in ((qpos, QPOS), (qvel, QVEL)):
            parts.append(torch.cat((start[key][:, None], path[key]), 1))
    offsets = states * torch.arange(cubes * tosses + 1)
    positions, velocities = (torch.cat(x).flatten(0, 1) for x in (qpos, qvel))
    return Tosses(positions, velocities, offsets)
