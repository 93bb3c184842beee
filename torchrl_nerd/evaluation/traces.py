"""Errors, energy and distance to the terrain over time, of rollouts in two dynamics."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import cast

import mujoco
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_nerd.dynamics.base import Dynamics
from torchrl_nerd.evaluation.rollout_error import (
    action_drive,
    initial_states,
    position_errors,
    rollout,
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


def mechanics(scene: Scene, states: TensorDictBase) -> dict[str, Tensor]:
    """What MuJoCo computes of each state ``[n]``; NaN where a state is not finite.

    Returns:
        ``energy (n,)``, kinetic plus that of gravity and joint springs, J; ``com (n, 3)``,
        m; ``momentum (n, 3)``, kg m/s; ``angular_momentum (n, 3)`` about the centre of
        mass, kg m^2/s; ``penetration (n,)``, the deepest contact, m. In world axes.
    """
    model, data = scene.model, mujoco.MjData(scene.model)
    mass, count = float(model.body_mass.sum()), len(states)
    sizes = {"energy": (), "com": (3,), "momentum": (3,), "angular_momentum": (3,)}
    found = {
        key: torch.full((count, *size), torch.nan, dtype=torch.float64)
        for key, size in {**sizes, "penetration": ()}.items()
    }
    both = torch.cat((states[QPOS], states[QVEL]), -1)  # (n, nq + nv)
    for i in torch.nonzero(both.isfinite().all(-1))[:, 0].tolist():
        data.qpos[:], data.qvel[:] = both[i].cpu().split((model.nq, model.nv))
        mujoco.mj_forward(model, data)
        mujoco.mj_energyPos(model, data)
        mujoco.mj_energyVel(model, data)
        mujoco.mj_subtreeVel(model, data)
        found["energy"][i] = float(data.energy.sum())
        found["com"][i] = torch.from_numpy(data.subtree_com[0])
        found["momentum"][i] = mass * torch.from_numpy(data.subtree_linvel[0])
        found["angular_momentum"][i] = torch.from_numpy(data.subtree_angmom[0])
        found["penetration"][i] = max((-c.dist for c in data.contact), default=0.0)
    return found


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
    paths = [rollout(one, start, steps, drive) for one in dynamics]
    errors = position_errors(scene, paths[1][QPOS], paths[0][QPOS])
    relative = torch.stack([e / e.nanmean().clamp_min(1e-12) for e in errors.values()])
    # over quantities and steps: (trajectories,)
    order = relative.mean((0, 2)).nan_to_num(nan=torch.inf).argsort()
    median = int(order[trajectories // 2])
    shown = [cast(TensorDict, path[median]) for path in paths]  # [steps + 1] each
    distances, terrain = None, start.get(TERRAIN, None)
    if scene.terrain is not None:
        ground = None if terrain is None else terrain[median].expand(steps + 1, -1)
        distances = [scene.clearances(p[QPOS], ground).amin(-1) for p in shown]
    return Traces(
        scene=scene,
        seconds=scene.control_step * torch.arange(steps + 1),
        errors=errors,
        energies=[mechanics(scene, path)["energy"] for path in shown],
        distances=distances,
    )
