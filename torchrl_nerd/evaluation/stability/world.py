"""What a case steps: any dynamics of a scene, or any TorchRL env with qpos and qvel."""

from functools import cache
from typing import Any, Protocol, cast

import mujoco
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Generator, Tensor
from torchrl.envs import EnvBase

from torchrl_nerd.dynamics import Dynamics, MujocoDynamics
from torchrl_nerd.keys import ACTION, QPOS, QVEL, TERRAIN
from torchrl_nerd.scenes import Scene

SETTLE, STILL = 5.0, 1e-3  # s; m/s and rad/s


class World(Protocol):
    """A robot that can be put anywhere and driven."""

    scene: Scene
    is_true: bool

    def roll(
        self,
        start: TensorDict,
        steps: int,
        torque: Tensor | None = None,
        every: int = 1,
    ) -> TensorDict:
        """States ``[rows, 1 + steps // every]``, the start first.

        Args:
            start: ``qpos``, ``qvel`` and, where the ground varies, ``terrain``.
            steps: control steps.
            torque: ``(rows, T, num_actuated)``, taken again from the start after T steps;
                None for none.
            every: steps between two states that are kept.
        """
        ...


class DynamicsWorld:
    """A `Dynamics`, driven by joint torques."""

    def __init__(self, dynamics: Dynamics) -> None:
        self.dynamics, self.scene = dynamics, dynamics.scene
        self.is_true = isinstance(dynamics, MujocoDynamics)

    def roll(
        self,
        start: TensorDict,
        steps: int,
        torque: Tensor | None = None,
        every: int = 1,
    ) -> TensorDict:
        """See `World.roll`."""
        state: TensorDictBase = start.select(QPOS, QVEL)
        terrain = start.get(TERRAIN, None)
        if torque is None:
            torque = idle(self.scene, len(start))[:, None]
        self.dynamics.reset(state)
        kept: list[Any] = [state]
        for step in range(steps):
            now = torque[:, step % torque.shape[1]]
            state = self.dynamics.step(state, now, terrain)
            if (step + 1) % every == 0:
                kept.append(state.select(QPOS, QVEL))
        return cast(TensorDict, torch.stack(kept, 1))


class EnvWorld:
    """Any `EnvBase` that shows ``qpos`` and ``qvel`` and can be set to a state.

    Torques become actions by their share of the largest ones of the scene's sampling: a
    case means the same drive to every env, in the env's own units.

    Args:
        env: of one batch dimension; ``reset(td, set_state=True)`` sets its state.
        scene: the robot it holds; its own ``scene`` where not given.
        is_true: whether the lines of true dynamics are to be kept.
    """

    def __init__(
        self, env: EnvBase, scene: Scene | None = None, is_true: bool = False
    ) -> None:
        self.env, self.is_true = env, is_true
        self.scene = cast(Scene, env.scene if scene is None else scene)

    def roll(
        self,
        start: TensorDict,
        steps: int,
        torque: Tensor | None = None,
        every: int = 1,
    ) -> TensorDict:
        """See `World.roll`; ends of episodes are stepped over."""
        rows = self.env.batch_size
        if rows != start.batch_size:
            raise ValueError(
                f"expected {rows.numel()} states, one of each row of the env, got "
                f"{start.batch_size.numel()}"
            )
        largest = torch.tensor(self.scene.sampling.torque, dtype=torch.float64)
        state = self.env.reset(start.clone(), set_state=True)
        kept = [state.select(QPOS, QVEL)]
        action = self.env.full_action_spec[ACTION].zero()
        for step in range(steps):
            if torque is not None and action.shape[-1] == len(largest):
                share = torque[:, step % torque.shape[1]] / largest
                action = share.to(action.dtype)
            state[ACTION] = action
            state = self.env.step(state)["next"]
            if (step + 1) % every == 0:
                kept.append(state.select(QPOS, QVEL))
        return cast(TensorDict, torch.stack(kept, 1))


def idle(scene: Scene, rows: int) -> Tensor:
    """No torque, ``(rows, num_actuated)``."""
    return torch.zeros(rows, len(scene.actuated), dtype=torch.float64)


def starts(scene: Scene, rows: int, generator: Generator) -> TensorDict:
    """States ``[rows]`` from the scene's training ranges."""
    return TensorDict(scene.sample_initial(rows, generator)[0], [rows])


def at_rest(scene: Scene, rows: int, height: float = 0.0) -> TensorDict:
    """The robot's reference pose, ``height`` (m) higher and not moving, ``[rows]``."""
    model = scene.model
    key = model.key_qpos[0] if model.nkey else model.qpos0
    qpos = torch.from_numpy(np.tile(key, (rows, 1)))
    if scene.base.is_floating:
        qpos[:, scene.base.qpos_address + 2] += height
    qvel = torch.zeros(rows, model.nv, dtype=torch.float64)
    start = TensorDict({QPOS: qpos, QVEL: qvel}, [rows])
    if scene.terrain is not None and scene.terrain.is_per_row:
        start[TERRAIN] = (
            torch.from_numpy(scene.terrain.default).expand(rows, -1).clone()
        )
    return start


@cache
def settled(scene: Scene, rows: int) -> TensorDict:
    """Where the robot comes to lie in true dynamics, dropped from its training ranges.

    Returns:
        Up to ``rows`` states at rest; fewer where it does not come to rest.
    """
    start = starts(scene, 2 * rows, Generator().manual_seed(0))
    start[QVEL] = 0.0 * start[QVEL]
    steps = round(SETTLE / scene.control_step)
    torque = idle(scene, 2 * rows)[:, None].expand(-1, steps, -1)
    path = MujocoDynamics(scene).rollout(start, torque, start.get(TERRAIN, None))
    for key in (QPOS, QVEL):
        start[key] = path[key][:, -1].clone()
    is_still = torch.amax(start[QVEL].abs(), -1) < STILL
    return rows_of(start, is_still.nonzero()[:rows, 0])


def rows_of(states: TensorDict, rows: Tensor) -> TensorDict:
    """Some of the states, by index or mask; a copy."""
    return cast(TensorDict, states[rows])


def length(x: Tensor) -> Tensor:
    """Of vectors ``(*batch, D)``, ``(*batch,)``."""
    return torch.linalg.vector_norm(x, dim=-1)


def clear_of_ground(scene: Scene, start: TensorDict) -> TensorDict:
    """The same states where nothing can be touched: lifted, or the ground lowered."""
    start = start.clone()
    if scene.base.is_floating:
        start[QPOS][:, scene.base.qpos_address + 2] += 100.0
    if scene.terrain is not None and scene.terrain.is_per_row:
        start[TERRAIN][:, 3] -= 100.0
    return start


def uniform_torque(scene: Scene, rows: int, steps: int, generator: Generator) -> Tensor:
    """Torques in the training range, ``(rows, steps, num_actuated)``."""
    high = torch.tensor(scene.sampling.torque, dtype=torch.float64)
    u = torch.rand(rows, steps, len(high), generator=generator, dtype=torch.float64)
    return (2.0 * u - 1.0) * high


def mechanics(scene: Scene, states: TensorDictBase) -> dict[str, np.ndarray]:
    """What MuJoCo computes of each state ``[n]``, velocities in world axes.

    Returns:
        ``energy (n,)``, J; ``com (n, 3)``, m; ``momentum (n, 3)``, kg m/s; ``spin
        (n, 3)``, angular momentum about the centre of mass, kg m^2/s; ``depth (n,)``, the
        deepest contact, m.
    """
    model = scene.model
    flags = int(model.opt.enableflags)
    data = mujoco.MjData(model)
    found: dict[str, list] = {
        k: [] for k in ("energy", "com", "momentum", "spin", "depth")
    }
    mass = float(model.body_mass.sum())
    for qpos, qvel in zip(states[QPOS].numpy(), states[QVEL].numpy(), strict=True):
        if not (np.isfinite(qpos).all() and np.isfinite(qvel).all()):
            for key, size in (("energy", ()), ("com", 3), ("momentum", 3), ("spin", 3)):
                found[key].append(np.full(size, np.nan))
            found["depth"].append(np.nan)
            continue
        data.qpos[:], data.qvel[:] = qpos, qvel
        mujoco.mj_forward(model, data)
        mujoco.mj_energyPos(model, data)
        mujoco.mj_energyVel(model, data)
        mujoco.mj_subtreeVel(model, data)
        found["energy"].append(float(data.energy.sum()))
        found["com"].append(data.subtree_com[0].copy())
        found["momentum"].append(mass * data.subtree_linvel[0])
        found["spin"].append(data.subtree_angmom[0].copy())
        found["depth"].append(max((-c.dist for c in data.contact), default=0.0))
    assert int(model.opt.enableflags) == flags
    return {key: np.array(value) for key, value in found.items()}


def largest(value: np.ndarray | Tensor) -> float:
    """The largest entry; infinity if any is no number."""
    array = np.asarray(value, dtype=float)
    return (
        float(array.max()) if array.size and np.isfinite(array).all() else float("inf")
    )
