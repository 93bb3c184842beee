"""Errors, energy and distance to the terrain over time, of rollouts in two dynamics."""

from collections.abc import Mapping, Sequence
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


@dataclass(frozen=True, eq=False)
class Traces:
    """Rollouts from the same initial states under the same actions.

    | field | meaning |
    |---|---|
    | ``scene`` | the robot |
    | ``seconds`` | ``(steps + 1,)`` |
    | ``errors`` | ``(trajectories, steps + 1)`` by quantity, see `position_errors` |
    | ``energies`` | J, ``(steps + 1,)`` in each dynamics, of the trajectory whose mean
      error is the median |
    | ``distances`` | m, smallest distance of that trajectory to the terrain, negative in
      contact; None without terrain |
    """

    scene: Scene
    seconds: Tensor
    errors: Mapping[str, Tensor]
    energies: Sequence[Tensor]
    distances: Sequence[Tensor] | None


def trace(
    dynamics: Dynamics, start: TensorDict, steps: int, drive: Drive, every: int = 1
) -> TensorDict:
    """``qpos`` and ``qvel`` of a rollout, ``[rows, 1 + steps // every]``, start first."""
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
    """Kinetic energy plus that of gravity and joint springs, J, ``(steps,)``.

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
    dynamics: Sequence[Dynamics],
    steps: int,
    trajectories: int,
    seed: int,
    random_actions: bool = False,
) -> Traces:
    """Roll out two dynamics, the second one the ground truth; see `action_drive`."""
    scene, start = scene_of(source), initial_states(source, trajectories, seed)
    drive = action_drive(source, trajectories, steps, seed, random_actions)
    paths = [trace(one, start, steps, drive) for one in dynamics]
    errors = position_errors(scene, paths[1][QPOS], paths[0][QPOS])
    relative = torch.stack([e / e.nanmean().clamp_min(1e-12) for e in errors.values()])
    order = relative.mean((0, 2)).nan_to_num(nan=torch.inf).argsort()
    median = int(order[trajectories // 2])
    shown = [cast(TensorDict, path[median]) for path in paths]
    distances, terrain = None, start.get(TERRAIN, None)
    if scene.terrain is not None:
        ground = None if terrain is None else terrain[median].expand(steps + 1, -1)
        distances = [scene.clearances(p[QPOS], ground).amin(-1) for p in shown]
    return Traces(
        scene=scene,
        seconds=scene.control_step * torch.arange(steps + 1),
        errors=errors,
        energies=[energy(scene, p[QPOS], p[QVEL]) for p in shown],
        distances=distances,
    )
