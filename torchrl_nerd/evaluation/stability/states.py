"""Where cases begin: the training ranges, at rest, or up in the air."""

import copy
from dataclasses import replace
from functools import cache
from typing import cast

import torch
from tensordict import TensorDict
from torch import Generator, Tensor

from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.geometry.rotations import quat_multiply, rotate
from torchrl_nerd.keys import QPOS, QVEL, TERRAIN
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.contact_points import ground_geoms
from torchrl_nerd.scenes.sampling import sample_torque
from torchrl_nerd.scenes.terrain import POSE_PARAMETERS

SETTLE, STILL = 5.0, 1e-3  # s; m/s and rad/s
TRIES = 8
HIGH = 100.0  # m


def idle(scene: Scene, rows: int) -> Tensor:
    """No torque, ``(rows, num_actuated)``."""
    return torch.zeros(rows, len(scene.actuated), dtype=torch.float64)


def starts(scene: Scene, rows: int, generator: Generator) -> TensorDict:
    """States ``[rows]`` from the scene's training ranges."""
    return TensorDict(scene.sample_initial(rows, generator)[0], [rows])


def nudged(start: TensorDict, size: float, generator: Generator) -> TensorDict:
    """The same states with every velocity off by normal noise of that size."""
    qvel = start[QVEL]
    noise = torch.randn(qvel.shape, generator=generator, dtype=qvel.dtype)
    return start.clone().update({QVEL: qvel + size * noise})


@cache
def settled(scene: Scene, rows: int) -> TensorDict:
    """Where the robot comes to lie in true dynamics, dropped from its training ranges.

    Where the ground varies, on that of the file.

    Returns:
        Up to ``rows`` states at rest, at least one; fewer where it seldom comes to rest.

    Raises:
        ValueError: it never did.
    """
    generator, found = Generator().manual_seed(0), []
    for _ in range(TRIES):
        found.append(_at_rest(scene, 2 * rows, generator))
        if sum(map(len, found)) >= rows:
            break
    at_rest = cast(TensorDict, TensorDict.cat(found))[:rows]
    if not len(at_rest):
        raise ValueError(
            f"expected a robot that comes to rest within {SETTLE} s of its drop, "
            f"'{scene.name}' did in none of {2 * rows * TRIES}"
        )
    return at_rest


def _at_rest(scene: Scene, drops: int, generator: Generator) -> TensorDict:
    """Those of so many drops that end at rest."""
    start = starts(scene, drops, generator)
    start[QVEL] = 0.0 * start[QVEL]
    if scene.terrain is not None and scene.terrain.is_per_row:
        start[TERRAIN] = torch.from_numpy(scene.terrain.default).expand(drops, -1)
    steps = round(SETTLE / scene.control_step)
    torque = idle(scene, drops)[:, None].expand(-1, steps, -1)
    path = MujocoDynamics(scene).rollout(start, torque, start.get(TERRAIN, None))
    for key in (QPOS, QVEL):
        start[key] = path[key][:, -1].clone()
    return rows_of(start, torch.amax(start[QVEL].abs(), -1) < STILL)


def rows_of(states: TensorDict, rows: Tensor) -> TensorDict:
    """Some of the states ``[n]``, by index or mask ``(n,)``; a copy."""
    return cast(TensorDict, states[rows])


def clear_of_ground(scene: Scene, start: TensorDict) -> TensorDict:
    """The same states where nothing can be touched: lifted, or the ground lowered."""
    start = start.clone()
    if scene.base.is_floating:
        start[QPOS][:, scene.base.qpos_address + 2] += HIGH
    if scene.terrain is not None and scene.terrain.is_per_row:
        start[TERRAIN][:, 3] -= HIGH
    return start


def uniform_torque(scene: Scene, rows: int, steps: int, generator: Generator) -> Tensor:
    """Torques in the training range, ``(rows, steps, num_actuated)``."""
    scale = torch.ones(rows, 1, dtype=torch.float64)
    return sample_torque(scene.sampling, scale, steps, generator)


def extreme_torques(scene: Scene, rows: int, steps: int) -> dict[str, Tensor]:
    """None, all there is and more, by name ``(rows, steps, num_actuated)``."""
    high = torch.tensor(scene.sampling.torque, dtype=torch.float64)
    full = high.expand(rows, steps, -1)
    sign = 1.0 - 2.0 * (torch.arange(steps, dtype=torch.float64) % 2.0)
    return {
        "zero": torch.zeros_like(full),
        "saturated": full,
        "1000-fold": 1000.0 * full,
        "alternating": sign[:, None] * full,
    }


def turned(scene: Scene, states: TensorDict, turn: Tensor) -> TensorDict:
    """States of a floating robot, turned about the world's origin, its ground with it.

    Ground that all rows share stays; see `ground_turned`.

    Args:
        scene: the robot.
        states: ``[*batch]``.
        turn: ``(*batch, 4)``.
    """
    q, v = scene.base.qpos_address, scene.base.dof_address
    states = states.clone()
    qpos, qvel = states[QPOS], states[QVEL]
    qpos[..., q : q + 3] = rotate(turn, qpos[..., q : q + 3])
    qpos[..., q + 3 : q + 7] = quat_multiply(turn, qpos[..., q + 3 : q + 7])
    qvel[..., v : v + 3] = rotate(turn, qvel[..., v : v + 3])
    if scene.terrain is not None and TERRAIN in states.keys():
        ground = states[TERRAIN]
        for part in scene.terrain.parameters.values():  # normals, or poses
            given = ground[..., part]
            given[..., :3] = rotate(turn, given[..., :3])
            if given.shape[-1] == POSE_PARAMETERS:
                given[..., 3:] = quat_multiply(turn, given[..., 3:])
    return states


def ground_turned(scene: Scene, turn: Tensor) -> Scene:
    """The robot over its ground, turned by a quaternion ``(4,)`` about the origin."""
    model = copy.copy(scene.model)
    for geom in ground_geoms(model):
        position = torch.from_numpy(scene.model.geom_pos[geom].copy())
        quat = torch.from_numpy(scene.model.geom_quat[geom].copy())
        model.geom_pos[geom] = rotate(turn, position).numpy()
        model.geom_quat[geom] = quat_multiply(turn, quat).numpy()
        model.geom_sameframe[geom] = 0  # or MuJoCo takes the body's frame for it
    return replace(scene, model=model)
