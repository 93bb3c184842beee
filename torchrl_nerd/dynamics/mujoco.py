"""Ground truth: all envs through MuJoCo's thread-pooled rollout in one call."""

import copy
import os
from typing import Any, cast

import mujoco
import mujoco.rollout
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_nerd.compiled import uncompiled
from torchrl_nerd.dynamics.base import as_numpy, check_step, ground_pose
from torchrl_nerd.keys import QPOS, QVEL, SENSORDATA
from torchrl_nerd.scenes.scene import Scene
from torchrl_nerd.scenes.support import silence_mujoco

STATE: Any = mujoco.mjtState
CONTROL = int(
    STATE.mjSTATE_QFRC_APPLIED | STATE.mjSTATE_MOCAP_POS | STATE.mjSTATE_MOCAP_QUAT
)


def torque_model(scene: Scene) -> mujoco.MjModel:
    """The scene's model driven by joint torques alone.

    Its own actuators are off, since the controller already turned actions into torques;
    no silent reset on bad numbers.
    """
    model = copy.copy(scene.model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    return model


def feels_forces(scene: Scene) -> bool:
    """Whether the model has sensors that need forces, such as touch."""
    stages = scene.model.sensor_needstage
    return bool((stages == mujoco.mjtStage.mjSTAGE_ACC).any())


def default_threads() -> int:
    """``NERD_THREADS`` for workers that share a machine, otherwise all processors.

    Raises:
        ValueError: the variable holds no number of threads.
    """
    said = os.environ.get("NERD_THREADS") or str(os.cpu_count() or 1)
    if not said.isdecimal() or int(said) < 1:
        raise ValueError(f"expected NERD_THREADS to be a number, got {said!r}")
    return int(said)


class MujocoDynamics:
    """MuJoCo itself, substeps and threads in C, no Python loop over envs.

    The solver's warm start is carried from step to step (it changes results by less than
    the solver's tolerance) and cleared for envs that are reset.

    Args:
        scene: robot, ground and substeps.
        num_threads: worker threads; by default as many as the environment variable
            ``NERD_THREADS`` says, or all processors.
    """

    kind = "ground truth"

    def __init__(self, scene: Scene, num_threads: int | None = None) -> None:
        self.scene = scene
        self.num_threads = num_threads or default_threads()
        self._start()

    def _start(self) -> None:
        self._model = torque_model(self.scene)
        self._data = [mujoco.MjData(self._model) for _ in range(self.num_threads)]
        self._pool = mujoco.rollout.Rollout(nthread=self.num_threads)
        self._warmstart = np.zeros((0, self._model.nv))
        self._felt = np.zeros((0, self._model.nsensordata))

    def __getstate__(self) -> dict:
        """Threads do not travel: a copy in another process starts its own."""
        kept = ("scene", "num_threads", "_warmstart", "_felt")
        return {name: copy.copy(self.__dict__[name]) for name in kept}

    def __setstate__(self, state: dict) -> None:
        self.scene, self.num_threads = state["scene"], state["num_threads"]
        self._start()
        self.__dict__.update(state)

    def reset(self, state: TensorDictBase, rows: Tensor | None = None) -> None:
        """Clear the warm start of ``rows (num_envs,)``; see `Dynamics.reset`."""
        count = state[QPOS].shape[0]
        if rows is None or len(self._warmstart) != count:
            self._warmstart = np.zeros((count, self._model.nv))
        else:
            self._warmstart[rows.cpu().numpy()] = 0.0

    def history(self) -> np.ndarray:
        """See `Dynamics.history`: the warm start."""
        return self._warmstart.copy()

    def restore(self, history: np.ndarray, rows: Tensor) -> None:
        """See `Dynamics.restore`."""
        mask = rows.cpu().numpy()
        self._warmstart[mask] = history[mask] if len(history) == len(mask) else 0.0

    @uncompiled
    def step(
        self, state: TensorDictBase, joint_torque: Tensor, terrain: Tensor | None = None
    ) -> TensorDictBase:
        """See `Dynamics.step`. Envs that MuJoCo gave up on come back as NaN."""
        check_step(self.scene, state, joint_torque, terrain)
        states = self.rollout(state, joint_torque[:, None], terrain)
        last = cast(TensorDictBase, states[:, 0])
        if feels_forces(self.scene):
            last[SENSORDATA] = torch.from_numpy(self._felt).to(last.device)
        return last

    def rollout(
        self, state: TensorDictBase, joint_torque: Tensor, terrain: Tensor | None = None
    ) -> TensorDict:
        """Many control steps in one call: what `step` gives one after the other.

        Args:
            state: ``qpos (rows, nq)``, ``qvel (rows, nv)``.
            joint_torque: ``(rows, T, num_actuated)``, each held over its control step.
            terrain: ``(rows, terrain.size)`` where the ground varies.

        Returns:
            ``[rows, T]``: ``qpos`` and ``qvel`` after each step; NaN from where MuJoCo
            gave up on.
        """
        qpos, qvel = (as_numpy(state[key]) for key in (QPOS, QVEL))
        fine = self._substeps(qpos, qvel, self._control(joint_torque, terrain))
        timestep, nq, nv = self._model.opt.timestep, self._model.nq, self._model.nv
        velocity = slice(1 + nq, 1 + nq + nv)  # of MuJoCo's state: time, qpos, qvel
        before = fine[:, -2, velocity] if fine.shape[1] > 1 else qvel
        with np.errstate(invalid="ignore"):  # infinite envs are found below
            self._warmstart = (fine[:, -1, velocity] - before) / timestep
        states = fine[:, self.scene.substeps - 1 :: self.scene.substeps]
        # an env that MuJoCo gave up on stopped before the end: its clock is behind
        clock = self.scene.control_step * np.arange(1, states.shape[1] + 1)
        is_late = abs(states[:, :, 0] - clock) > 0.5 * timestep
        position = np.ascontiguousarray(states[:, :, 1 : velocity.start])
        speed = np.ascontiguousarray(states[:, :, velocity])
        if is_late.any():
            position[is_late], speed[is_late] = np.nan, np.nan
            self._warmstart[is_late[:, -1]] = 0.0
        device = state[QPOS].device
        values = {QPOS: torch.from_numpy(position), QVEL: torch.from_numpy(speed)}
        return TensorDict(values, [*states.shape[:2]]).to(device)

    def _control(self, joint_torque: Tensor, terrain: Tensor | None) -> np.ndarray:
        """MuJoCo's control vector, ``(rows, T, size)``: applied force, ground's pose."""
        size = mujoco.mj_stateSize(self._model, CONTROL)
        control = np.zeros((*joint_torque.shape[:-1], size))
        control[..., self.scene.actuated] = as_numpy(joint_torque)
        pose, data = ground_pose(self.scene, terrain), self._data[0]
        fixed = np.concatenate((data.mocap_pos.ravel(), data.mocap_quat.ravel()))
        varied = fixed if pose is None else as_numpy(pose)[:, None]
        control[..., self._model.nv :] = varied
        return control

    def _substeps(
        self, qpos: np.ndarray, qvel: np.ndarray, control: np.ndarray
    ) -> np.ndarray:
        """The state after every substep, ``(rows, T * substeps, state)``."""
        rows = len(qpos)
        size = mujoco.mj_stateSize(self._model, STATE.mjSTATE_FULLPHYSICS)
        self._felt = np.zeros((rows, self._model.nsensordata))
        if not rows:  # MuJoCo itself would crash
            return np.zeros((0, control.shape[1] * self.scene.substeps, size))
        start = np.zeros((rows, size))  # time, qpos, qvel, and what is left at zero
        known = np.concatenate((qpos, qvel), 1)
        start[:, 1 : 1 + known.shape[1]] = known
        if len(self._warmstart) != rows:
            self._warmstart = np.zeros((rows, self._model.nv))
        with silence_mujoco():
            states, felt = self._pool.rollout(
                self._model,
                self._data,
                start,
                np.repeat(control, self.scene.substeps, 1),
                control_spec=CONTROL,
                initial_warmstart=self._warmstart,
            )
        self._felt = felt[:, -1].copy()
        return states
