"""Test motions of varied robots: parameters inside their ranges, at corners, outside."""

from typing import Literal, cast

import torch
from tensordict import TensorDict
from torch import Generator, Tensor

from torchrl_nerd.data.simulate import as_transitions, is_sound
from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.keys import PARAMETERS, TERRAIN
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.commands import held
from torchrl_nerd.scenes.sampling import sample_correlated_commands

Region = Literal["inside", "corners", "outside"]
BEYOND = 0.25  # of a range's width, in log for factors


def draw_parameters(
    scene: Scene, region: Region, rows: int, generator: Generator
) -> Tensor:
    """Parameters ``(rows, size)`` of a region, float64.

    Outside: beyond the upper end; beyond either end where the value is a factor.
    """
    variation = scene.variation
    assert variation is not None
    u = torch.rand(rows, variation.size, dtype=torch.float64, generator=generator)
    if region == "corners":
        u = u.round()
    elif region == "outside":
        factors = torch.tensor([p.is_factor for p in variation.parameters])
        u = torch.where((u < 0.5) & factors, -BEYOND, 1.0 + BEYOND)
    return variation.values(u)


def motions(
    scene: Scene, parameters: list[Tensor], steps: list[int], generator: Generator
) -> TensorDict:
    """Transitions ``[rows, sum of steps]``; parameters change after each part.

    Trajectories that diverge are left out.
    """
    rows, total = len(parameters[0]), sum(steps)
    start, scale = scene.sample_initial(rows, generator)
    terrain = start.pop(TERRAIN, None)
    how = total, scene.control_step, generator
    commands = sample_correlated_commands(scene.sampling, scale, *how)
    dynamics, state = MujocoDynamics(scene), TensorDict(start, [rows])
    dynamics.reset(state)
    path, own = [state[:, None]], []
    for part, given in zip(commands.split(steps, 1), parameters, strict=True):
        last = cast(TensorDict, path[-1][:, -1]).set(PARAMETERS, given)
        torque, ctrl = held(scene, part)
        path.append(dynamics.rollout(last, torque, terrain, ctrl))
        own.append(given[:, None].expand(-1, part.shape[1], -1))
    data = as_transitions(scene, path, [commands], terrain)
    data[PARAMETERS] = torch.cat(own, 1)
    return cast(TensorDict, data[is_sound(data)])
