"""What learned and true rollouts keep to: energy, and the gap to the ground."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import cast

import mujoco
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_nerd.dynamics.base import Dynamics
from torchrl_nerd.evaluation.rollout_error import (
    Drive,
    action_drive,
    initial_states,
    position_errors,
    scene_of,
)
from torchrl_nerd.keys import QPOS, QVEL, TERRAIN
from torchrl_nerd.robots import Source
from torchrl_nerd.scenes import Scene

NAMES = ("learned", "MuJoCo")


@dataclass(frozen=True, eq=False)
class Traces:
    """Rollouts from the same starts, and one of them closely.

    | field | meaning |
    |---|---|
    | ``scene`` | the robot |
    | ``seconds`` | ``(steps + 1,)`` |
    | ``errors`` | ``(rows, steps + 1)`` by quantity, see `position_errors` |
    | ``row`` | the one whose mean error is in the middle |
    | ``energies`` | J, ``(steps + 1,)`` of that row, by NAMES |
    | ``gaps`` | m, its smallest distance to the ground; None without one |
    """

    scene: Scene
    seconds: Tensor
    errors: Mapping[str, Tensor]
    row: int
    energies: Mapping[str, Tensor]
    gaps: Mapping[str, Tensor] | None


def trace(
    dynamics: Dynamics, start: TensorDict, steps: int, drive: Drive, every: int = 1
) -> TensorDict:
    """States ``[rows, 1 + steps // every]``, the start first: ``qpos`` and ``qvel``."""
    terrain = start.get(TERRAIN, None)
    state: TensorDictBase = start.select(QPOS, QVEL)
    dynamics.reset(state)
    states = [state]
    for step in range(steps):
        state = dynamics.step(state, drive(step, state), terrain)
        if (step + 1) % every == 0:
            states.append(state.select(QPOS, QVEL))
    return cast(TensorDict, TensorDict.stack(states, 1))


def energy(scene: Scene, qpos: Tensor, qvel: Tensor) -> Tensor:
    """Kinetic energy and that of gravity and joint springs, J, ``(steps,)``.

    Args:
        scene: the robot.
        qpos: ``(steps, nq)``.
        qvel: ``(steps, nv)``.
    """
    model, data, values = scene.model, mujoco.MjData(scene.model), []
    for q, v in zip(qpos.cpu().numpy(), qvel.cpu().numpy(), strict=True):
        if not (np.isfinite(q).all() and np.isfinite(v).all()):
            values.append(np.nan)
            continue
        data.qpos[:], data.qvel[:] = q, v
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_energyPos(model, data)
        mujoco.mj_energyVel(model, data)
        values.append(float(data.energy.sum()))
    return torch.tensor(values, dtype=torch.float64)


def compare_traces(
    source: Source,
    learned: Dynamics,
    truth: Dynamics,
    steps: int,
    rows: int,
    seed: int,
    random_actions: bool = False,
) -> Traces:
    """Both from the same starts under the same actions; see `passive_errors`."""
    scene, start = scene_of(source), initial_states(source, rows, seed)
    drive = action_drive(source, rows, steps, seed, random_actions)
    paths = [trace(dynamics, start, steps, drive) for dynamics in (learned, truth)]
    errors = position_errors(scene, paths[1][QPOS], paths[0][QPOS])
    score = torch.stack([e / e.nanmean().clamp_min(1e-12) for e in errors.values()])
    order = score.mean((0, 2)).nan_to_num(nan=torch.inf).argsort()
    row = int(order[rows // 2])
    terrain = start.get(TERRAIN, None)
    ground = None if terrain is None else terrain[row].expand(steps + 1, -1)
    chosen = {
        name: cast(TensorDict, path[row])
        for name, path in zip(NAMES, paths, strict=True)
    }
    gaps = None
    if scene.terrain is not None:
        gaps = {
            k: scene.clearances(p[QPOS], ground).amin(-1) for k, p in chosen.items()
        }
    return Traces(
        scene=scene,
        seconds=scene.control_step * torch.arange(steps + 1),
        errors=errors,
        row=row,
        energies={k: energy(scene, p[QPOS], p[QVEL]) for k, p in chosen.items()},
        gaps=gaps,
    )
