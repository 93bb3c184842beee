"""Where cases start: the training range, at rest, in the air; mechanics of a state."""

from functools import cache
from typing import cast

import mujoco
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Generator, Tensor

from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.evaluation.rollout_error import rollout
from torchrl_nerd.geometry.rotations import quat_multiply, rotate
from torchrl_nerd.keys import QPOS, QVEL, TERRAIN
from torchrl_nerd.scenes import Scene

SETTLE, AT_REST = 5.0, 1e-3  # s; m/s and rad/s
TRIES = 8
HIGH = 100.0  # m


def sample_states(scene: Scene, count: int, generator: Generator) -> TensorDict:
    """States ``[count]`` from the scene's training range."""
    return TensorDict(scene.sample_initial(count, generator)[0], [count])


@cache
def settled_states(scene: Scene, count: int) -> TensorDict:
    """Up to ``count`` states at rest, at least one: dropped from the training range.

    Where the ground varies, on that of the file.

    Raises:
        ValueError: it never came to rest.
    """
    generator, found = Generator().manual_seed(0), []
    for _ in range(TRIES):
        found.append(_drop(scene, 2 * count, generator))
        if sum(map(len, found)) >= count:
            break
    at_rest = cast(TensorDict, TensorDict.cat(found))[:count]
    if not len(at_rest):
        raise ValueError(
            f"expected a robot that comes to rest within {SETTLE} s of its drop, "
            f"'{scene.name}' did in none of {2 * count * TRIES}"
        )
    return at_rest


def _drop(scene: Scene, count: int, generator: Generator) -> TensorDict:
    """The final states of those drops that end at rest."""
    start = sample_states(scene, count, generator)
    start[QVEL] = 0.0 * start[QVEL]
    if scene.terrain is not None and scene.terrain.is_per_env:
        start[TERRAIN] = torch.from_numpy(scene.terrain.default).expand(count, -1)
    steps = round(SETTLE / scene.control_step)
    path = rollout(MujocoDynamics(scene), start, steps, every=steps)
    start.update(path[:, -1])
    return cast(TensorDict, start[torch.amax(start[QVEL].abs(), -1) < AT_REST])


def clear_of_ground(scene: Scene, start: TensorDict) -> TensorDict:
    """The same states out of reach of the ground: lifted, or the ground lowered."""
    start = start.clone()
    if scene.base.is_floating:
        start[QPOS][:, scene.base.qpos_address + 2] += HIGH
    if scene.terrain is not None and scene.terrain.is_per_env:
        start[TERRAIN][:, 3] -= HIGH
    return start


def rotated(scene: Scene, states: TensorDict, quat: Tensor) -> TensorDict:
    """States ``[*batch]``, rotated about the world's origin by ``quat (*batch, 4)``.

    So is their ground, unless all trajectories share it.
    """
    q, v = scene.base.qpos_address, scene.base.dof_address
    states = states.clone()
    qpos, qvel = states[QPOS], states[QVEL]
    qpos[..., q : q + 3] = rotate(quat, qpos[..., q : q + 3])
    qpos[..., q + 3 : q + 7] = quat_multiply(quat, qpos[..., q + 3 : q + 7])
    qvel[..., v : v + 3] = rotate(quat, qvel[..., v : v + 3])
    if scene.terrain is not None and TERRAIN in states.keys():
        for plane in scene.terrain.split(states[TERRAIN]):
            plane[..., :3] = rotate(quat, plane[..., :3])  # normals
    return states


def robot_root(scene: Scene) -> int:
    """The body that carries the robot: a floating base, else the world."""
    return scene.base.body if scene.base.is_floating else 0


def robot_mass(scene: Scene) -> float:
    """Mass of the robot without props and what stands in the world, kg."""
    return float(scene.model.body_subtreemass[robot_root(scene)])


def mechanics(scene: Scene, states: TensorDictBase) -> dict[str, Tensor]:
    """What MuJoCo computes of each state ``[n]``; NaN where a state is not finite.

    Returns:
        Of the robot, without props, but for the energy, which is of all: ``energy (n,)``,
        kinetic plus that of gravity and joint springs, J; ``com (n, 3)``, m; ``momentum
        (n, 3)``, kg m/s; ``angular_momentum (n, 3)`` about the centre of mass, kg m^2/s;
        ``penetration (n,)``, the deepest contact, m. In world axes.
    """
    model, data = scene.model, mujoco.MjData(scene.model)
    root, mass = robot_root(scene), robot_mass(scene)
    none = torch.full((len(states), 3), torch.nan, dtype=torch.float64)
    found = {k: none.clone() for k in ("com", "momentum", "angular_momentum")}
    found |= {k: none[:, 0].clone() for k in ("energy", "penetration")}
    both = torch.cat((states[QPOS], states[QVEL]), -1)  # (n, nq + nv)
    for i in torch.nonzero(both.isfinite().all(-1))[:, 0].tolist():
        data.qpos[:], data.qvel[:] = both[i].cpu().split((model.nq, model.nv))
        mujoco.mj_forward(model, data)
        mujoco.mj_energyPos(model, data)
        mujoco.mj_energyVel(model, data)
        mujoco.mj_subtreeVel(model, data)
        found["energy"][i] = float(data.energy.sum())
        found["com"][i] = torch.from_numpy(data.subtree_com[root])
        found["momentum"][i] = mass * torch.from_numpy(data.subtree_linvel[root])
        found["angular_momentum"][i] = torch.from_numpy(data.subtree_angmom[root])
        found["penetration"][i] = max((-c.dist for c in data.contact), default=0.0)
    return found
