"""Test motions of varied robots: parameters inside their ranges, at corners, outside."""

from typing import Literal, cast

import torch
from tensordict import TensorDict
from torch import Generator, Tensor

from torchrl_nerd.data.simulate import as_transitions, is_sound
from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.keys import PARAMETERS, QPOS, QVEL, TERRAIN
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
    drawn = sample_correlated_commands(scene.sampling, scale, *how).split(steps, 1)
    dynamics, state = MujocoDynamics(scene), TensorDict(start, [rows])
    dynamics.reset(state)
    path, own, commands = [state[:, None]], [], []
    drive = scene.sampling.drive
    for part, given in zip(drawn, parameters, strict=True):
        # what depends on the state, as in the training data, is made step by step
        for command in (part,) if drive is None else part.split(1, 1):
            last = cast(TensorDict, path[-1][:, -1]).set(PARAMETERS, given)
            if drive is not None:
                command = drive(last[QPOS], last[QVEL], scale, generator)[:, None]
            torque, ctrl = held(scene, command)
            path.append(dynamics.rollout(last, torque, terrain, ctrl))
            commands.append(command)
        own.append(given[:, None].expand(-1, part.shape[1], -1))
    data = as_transitions(scene, path, commands, terrain)
    data[PARAMETERS] = torch.cat(own, 1)
    return cast(TensorDict, data[is_sound(data)])
