"""Ground truth: all envs through MuJoCo's batch of simulations in one call."""

import copy
import ctypes
import os
from weakref import WeakSet

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_nerd.dynamics.base import Engine, as_numpy, check_step, ground_pose
from torchrl_nerd.keys import PARAMETERS, QPOS, QVEL, SENSORDATA
from torchrl_nerd.scenes.scene import Scene
from torchrl_nerd.scenes.support import silence_mujoco
from torchrl_nerd.scenes.variation import Variation
from torchrl_nerd.settings import expect_count


def engine_model(scene: Scene, has_actuators: bool) -> mujoco.MjModel:
    """The scene's model, driven by its own actuators or by joint torques alone.

    No silent reset on bad numbers.
    """
    model = copy.copy(scene.model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    if not has_actuators:
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
    return model


def default_threads() -> int:
    """``NERD_THREADS`` or all processors allowed; a ValueError if it is no number."""
    try:
        allowed = len(os.sched_getaffinity(0))
    except AttributeError:  # not on Linux
        allowed = os.cpu_count() or 1
    said = os.environ.get("NERD_THREADS") or str(allowed)
    if not said.isdecimal() or int(said) < 1:
        raise ValueError(f"expected NERD_THREADS to be a number, got {said!r}")
    return int(said)


class BatchParameters:
    """Parameters of a `Variation` in a batch that begins with the scene's own model."""

    def __init__(self, variation: Variation, batch: Batch) -> None:
        self.variation, self.batch = variation, batch
        num_envs, dofs = batch.nsim, len(variation.actuated)
        self._values = np.full((num_envs, variation.size), np.nan)
        self._strength = np.ones((num_envs, dofs))
        self._delay = np.zeros(num_envs, int)

    def write(self, parameters: np.ndarray) -> None:
        """Give every simulation its parameters ``(num_envs, size)``.

        Raises:
            ValueError: another shape, or parameters of no robot; nothing has changed then.
        """
        if parameters.shape != self._values.shape:
            raise ValueError(
                f"expected parameters of shape {self._values.shape}, got "
                f"{parameters.shape}"
            )
        changed = np.flatnonzero((parameters != self._values).any(1))
        if len(changed):
            self.variation.check(torch.from_numpy(parameters[changed]))
            values = parameters[changed]
            for name, value in self.variation.fields(values).items():
                self.batch.expand(name)[changed] = value
            self.batch.set_const(changed)
            self._values[changed] = values
            self._strength[changed] = self.variation.strength(values)
            self._delay[changed] = self.variation.delay(values)

    def applied(
        self, command: np.ndarray, late: np.ndarray, is_ctrl: bool
    ) -> np.ndarray:
        """What the engine gets where ``command (num_envs, m)`` is asked of the motors.

        Of a ``ctrl`` the model itself weakens the actuators. ``late (num_envs,
        1 + max_delay, at least m)`` holds the last commands, and takes this one in.
        """
        late[:, 1:] = late[:, :-1].copy()
        late[:, 0, : command.shape[1]] = command
        now = late[np.arange(len(late)), self._delay, : command.shape[1]]
        return now if is_ctrl else self._strength * now


class MujocoDynamics(Engine):
    """MuJoCo itself, substeps and threads in C, no Python loop over envs.

    With ``ctrl`` a step is ``mj_step`` itself, substep by substep, to the last bit. The
    solver's warm start is carried from step to step, as ``mj_step`` does (it changes
    results by less than the solver's tolerance), and cleared for envs that are reset.
    Where the scene varies, each env has the ``parameters`` of its state; without any all
    are as the scene is.

    Args:
        scene: robot, ground and substeps.
        num_threads: that step; by default as many as the environment variable
            ``NERD_THREADS`` says, or all processors that the process may use.

    Raises:
        ValueError: a number of threads below 1.
    """

    def __init__(self, scene: Scene, num_threads: int | None = None) -> None:
        num_threads = default_threads() if num_threads is None else num_threads
        expect_count(1, num_threads=num_threads)
        super().__init__(scene, num_threads)
        self.num_threads = num_threads
        self._allocate(0)

    def _allocate(self, count: int) -> None:
        model = self._model = engine_model(self.scene, self.has_actuators)
        varied = self.scene.variation
        size = max(len(self.scene.actuated), model.nu)
        length = 1 if varied is None else 1 + varied.max_delay
        self._late = np.zeros((count, length, size))  # commands, the latest first
        self._own: BatchParameters | None = None
        self._batch: Batch | None = None
        self._warmstart = np.zeros((count, model.nv))
        if count:
            self._batch = Batch(model, count, self.num_threads)
            self._warmstart = self._batch.bind("qacc_warmstart")
            self._warmstart[:] = 0.0
            if self.feels_forces:  # filled by the steps that follow
                self._batch.bind(SENSORDATA)
        _STARTED.add(self)

    def _restart(self) -> None:
        """As `Engine._restart`, with the same past."""
        past = self.history()
        self._allocate(self._count)
        self.restore(past, torch.ones(self._count, dtype=torch.bool))

    def history(self) -> tuple[np.ndarray, np.ndarray] | None:
        """See `Dynamics.history`: the warm start and the commands that may be late."""
        return (self._warmstart.copy(), self._late.copy()) if self._count else None

    def restore(
        self, history: tuple[np.ndarray, np.ndarray] | None, is_restored: Tensor
    ) -> None:
        """See `Dynamics.restore`; without a history, to none."""
        mask, pasts = is_restored.cpu().numpy(), (self._warmstart, self._late)
        for past, then in zip(pasts, history or (None, None), strict=True):
            past[mask] = 0.0 if then is None else then[mask]

    def _step(
        self, state: TensorDictBase, command: Tensor, terrain: Tensor | None
    ) -> dict[str, Tensor]:
        moved = self._roll(state, command[:, None], terrain)
        values = {key: x[:, 0] for key, x in moved.items()}
        if self.feels_forces:
            felt = np.zeros((0, self._model.nsensordata))
            if self._batch is not None:
                felt = self._batch.bind(SENSORDATA).copy()
            values[SENSORDATA] = torch.from_numpy(felt)
        return values

    def rollout(
        self,
        state: TensorDictBase,
        joint_torque: Tensor | None,
        terrain: Tensor | None = None,
        ctrl: Tensor | None = None,
    ) -> TensorDict:
        """Many control steps in one call: what `step` gives one after the other.

        Args:
            state: ``qpos (num_envs, nq)``, ``qvel (num_envs, nv)``.
            joint_torque: ``(num_envs, T, num_actuated)``, each held over its control
                step; with ``ctrl`` it is not used, and may be None.
            terrain: ``(num_envs, terrain.size)`` where the ground varies.
            ctrl: ``(num_envs, T, nu)``, each held: MuJoCo's actuators act in every
                substep.

        Returns:
            ``[num_envs, T]``: ``qpos`` and ``qvel`` after each step; NaN from where
            MuJoCo gave up on.

        Raises:
            ValueError: a shape that is not the scene's, or a ground that is not finite.
        """
        given = joint_torque, ctrl
        if all(x is None or x.shape[1] for x in given):
            torque, now = (None if x is None else x[:, 0] for x in given)
            check_step(self.scene, state, torque, terrain, now)
        commands = self._command(*given)
        moved = self._roll(state, commands, terrain)
        return TensorDict(moved, commands.shape[:2]).to(state[QPOS].device)

    def _roll(
        self, state: TensorDictBase, command: Tensor, terrain: Tensor | None
    ) -> dict[str, Tensor]:
        """``qpos`` and ``qvel`` after each of the commands ``(num_envs, T, m)``."""
        num_envs, length = command.shape[:2]
        qpos = np.empty((num_envs, length, self._model.nq))
        qvel = np.empty((num_envs, length, self._model.nv))
        if self._batch is not None and length:
            self._vary(self._batch, state.get(PARAMETERS, None))
            batch = self._batch
            batch.bind("time")[:] = 0.0
            placed = {key: state[key] for key in (QPOS, QVEL)}
            for key, value in (placed | ground_pose(self.scene, terrain)).items():
                batch.bind(key)[:] = as_numpy(value)
            commands, is_whole = as_numpy(command), np.ones(num_envs, bool)
            for t in range(length):
                self._advance(batch, commands[:, t], is_whole)
                qpos[:, t], qvel[:, t] = batch.bind(QPOS), batch.bind(QVEL)
        return {QPOS: torch.from_numpy(qpos), QVEL: torch.from_numpy(qvel)}

    def _vary(self, batch: Batch, parameters: Tensor | None) -> None:
        """Give every simulation its parameters, if there are any."""
        if self.scene.variation is None:
            return
        if parameters is not None:
            self._own = self._own or BatchParameters(self.scene.variation, batch)
            self._own.write(as_numpy(parameters))
        elif self._own is not None:  # the scene's own robot again, in a new batch
            self._restart()

    def _advance(self, batch: Batch, command: np.ndarray, is_whole: np.ndarray) -> None:
        """One control step; a simulation with a warning is NaN, and whole no longer."""
        if self._own is not None:
            command = self._own.applied(command, self._late, self.has_actuators)
        if self.has_actuators:
            batch.bind("ctrl")[:] = command
        else:
            batch.bind("qfrc_applied")[:, self.scene.actuated] = command
        counts = batch.warning[..., 1]  # (num_envs, kinds of warning), as they are now
        before = counts.copy()
        ids = None if is_whole.all() else np.flatnonzero(is_whole)
        with silence_mujoco():
            batch.step(ids, nstep=self.scene.substeps)
        is_whole &= (counts == before).all(-1)
        batch.bind(QPOS)[~is_whole] = np.nan
        batch.bind(QVEL)[~is_whole] = np.nan
        self._warmstart[~is_whole] = 0.0


_STARTED: WeakSet[MujocoDynamics] = WeakSet()


def _restart_all() -> None:
    """New threads in a process that was forked, where the old ones are not.

    Freeing the old ones would wait for them, so they are kept.
    """
    for dynamics in list(_STARTED):
        if dynamics._batch is not None:
            ctypes.pythonapi.Py_IncRef(ctypes.py_object(dynamics._batch))
            dynamics._restart()


if hasattr(os, "register_at_fork"):  # not on Windows
    os.register_at_fork(after_in_child=_restart_all)
