"""Ground truth on dm_control: one `Physics` per env, stepped as dm_control steps it."""

import warnings
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_nerd.dynamics.base import (
    Engine,
    as_numpy,
    ground_pose,
    refuse_variation,
)
from torchrl_nerd.dynamics.mujoco import engine_model
from torchrl_nerd.keys import QPOS, QVEL, SENSORDATA
from torchrl_nerd.scenes.scene import Scene

if TYPE_CHECKING:
    from dm_control.mujoco import Physics

INTEGRATED = int(mujoco.mjtState.mjSTATE_INTEGRATION)


def make_physics(scene: Scene, has_actuators: bool) -> "Physics":
    """A dm_control `Physics` of the scene, see `engine_model`.

    dm_control is imported here, on first use: it looks for a display and says so.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from dm_control.mujoco import Physics, wrapper
    return Physics.from_model(wrapper.MjModel(engine_model(scene, has_actuators)))


class DMControlDynamics(Engine):
    """The same envs on dm_control `Physics` objects, bit for bit what it would give.

    An env whose state is the one its `Physics` was left in goes on from there, as an
    episode of dm_control does; any other state is written in first, with the speeds of
    servos, which dm_control itself takes as zero in that substep. For many envs
    `MujocoDynamics` is faster: here every env costs a Python call.

    Raises:
        ValueError: a scene whose parameters differ from env to env.
    """

    def __init__(self, scene: Scene) -> None:
        refuse_variation(scene, "dm_control")
        super().__init__(scene)
        self._allocate(0)

    def _allocate(self, count: int) -> None:
        given = self.scene, self.has_actuators
        self._physics = [make_physics(*given) for _ in range(count)]

    def history(self) -> list[np.ndarray]:
        """See `Dynamics.history`: all that MuJoCo integrates, warm start and time too."""
        pasts = []
        for physics in self._physics:
            where = physics.model.ptr, physics.data.ptr
            pasts.append(np.empty(mujoco.mj_stateSize(where[0], INTEGRATED)))
            mujoco.mj_getState(*where, pasts[-1], INTEGRATED)
        return pasts

    def restore(self, history: list[np.ndarray] | None, is_restored: Tensor) -> None:
        """See `Dynamics.restore`; without a history, to the state of a new `Physics`."""
        for env in is_restored.nonzero()[:, 0].tolist():
            physics = self._physics[env]
            if not history:
                physics.reset()
                continue
            where = physics.model.ptr, physics.data.ptr
            mujoco.mj_resetData(*where)  # warnings of a step that is taken back
            mujoco.mj_setState(*where, history[env], INTEGRATED)
            mujoco.mj_step1(*where)  # with which `Physics` ends a step

    def _step(
        self, state: TensorDictBase, command: Tensor, terrain: Tensor | None
    ) -> dict[str, Tensor]:
        given = {key: state[key] for key in (QPOS, QVEL)}
        given |= ground_pose(self.scene, terrain)
        placed, told = {k: as_numpy(x) for k, x in given.items()}, as_numpy(command)
        next_qpos, next_qvel = np.empty_like(placed[QPOS]), np.empty_like(placed[QVEL])
        felt = np.empty((len(told), self.scene.model.nsensordata))
        for env, physics in enumerate(self._physics):
            _place(physics, {key: value[env] for key, value in placed.items()})
            if self.has_actuators:
                physics.set_control(told[env])
            else:
                physics.data.qfrc_applied[self.scene.actuated] = told[env]
            with physics.suppress_physics_errors():
                physics.step(self.scene.substeps)
            is_broken = physics.data.warning.number.any()
            next_qpos[env] = np.nan if is_broken else physics.data.qpos
            next_qvel[env] = np.nan if is_broken else physics.data.qvel
            felt[env] = physics.data.sensordata
        values = {QPOS: next_qpos, QVEL: next_qvel}
        if self.feels_forces:
            values[SENSORDATA] = felt
        return {key: torch.from_numpy(value) for key, value in values.items()}


def _place(physics: "Physics", values: dict[str, np.ndarray]) -> None:
    """Put an env and its ground where they should be, unless they are there already."""
    data = physics.data
    if all(np.array_equal(getattr(data, key), x) for key, x in values.items()):
        return
    with physics.reset_context():
        for key, value in values.items():
            getattr(data, key)[:] = value
    # `Physics` does this without actuators, whose speeds its next substep needs
    mujoco.mj_fwdVelocity(physics.model.ptr, data.ptr)
