"""Ground truth on a GPU: all envs as one batch of MuJoCo Warp, in float32."""

import sys
from contextlib import AbstractContextManager
from importlib.util import find_spec
from typing import Any, cast

import mujoco
import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_nerd.dynamics.base import Engine, ground_pose, refuse_variation
from torchrl_nerd.dynamics.mujoco import engine_model
from torchrl_nerd.keys import QPOS, QVEL, SENSORDATA
from torchrl_nerd.scenes.scene import Scene

LARGEST = 1e10  # m, rad, m/s, rad/s: MuJoCo's mjMAXVAL, beyond which it gives up
CONTACTS_PER_PAIR = 8  # of two geoms, two boxes at most; MuJoCo Warp has no more
CONTACTS_PER_HEIGHT_FIELD = 50  # of it and another geom, MuJoCo's mjMAXCONPAIR


class MujocoWarpDynamics(Engine):
    """MuJoCo Warp: states stay on the device, one launch of kernels for all envs.

    States are float64 like everywhere, but Warp computes in float32: a step agrees with
    `MujocoDynamics` to float32's rounding, and far from the origin positions are as
    coarse as float32 is there. On a GPU the order of sums, and with it the last digits,
    may change from run to run. The first step of a scene compiles kernels, minutes once;
    Warp keeps them on the disk. The solver's warm start is carried from step to step and
    cleared for envs that are reset.

    Args:
        scene: robot, ground and substeps.
        device: ``"cuda"`` or, slowly and one env after the other, ``"cpu"``.
        max_contacts: memory for so many contacts an env; by default as many as its geoms
            can have. Where fewer are given and more occur, envs come back as NaN.
        is_capturing: on a GPU, replay the control step as one CUDA graph.

    Raises:
        ModuleNotFoundError: mujoco-warp is not installed.
        ValueError: a model or a device that Warp cannot step on (named).
    """

    def __init__(
        self,
        scene: Scene,
        device: torch.device | str = "cuda",
        max_contacts: int | None = None,
        is_capturing: bool = True,
    ) -> None:
        refuse_variation(scene, "MuJoCo Warp")
        super().__init__(scene, device, max_contacts, is_capturing)
        self.device = torch.device(device)
        self.max_contacts, self.is_capturing = max_contacts, is_capturing
        self._restart()

    def _restart(self) -> None:
        self._warp, self._engine = _import_warp()
        try:
            self._place = self._warp.device_from_torch(self.device)
        except (RuntimeError, ValueError) as error:
            said = f"MuJoCo Warp finds no device '{self.device}' here"
            raise ValueError(said) from error
        self._source = engine_model(self.scene, self.has_actuators)
        if not self.has_actuators:
            _weaken_actuators(self._source)
        # a flag that Warp does not know: it never resets an env by itself
        disabled = self._source.opt.disableflags
        no_reset = int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        self._source.opt.disableflags = disabled & ~no_reset
        try:
            with self._warp.ScopedDevice(self._place):
                self._model = self._engine.put_model(self._source)
        except (NotImplementedError, ValueError) as error:
            raise ValueError(
                f"MuJoCo Warp cannot step scene '{self.scene.name}': {error}"
            ) from error
        from torchrl_nerd.dynamics.warp_frames import straighten_frames

        self._model.callback.contactfilter = straighten_frames
        self._model.opt.warn_overflow = 0  # such envs become NaN
        super()._restart()

    def __getstate__(self) -> dict[str, Any]:
        """As `Engine`'s; nothing of it is on the device."""
        past = self.history()
        return super().__getstate__() | {"past": None if past is None else past.cpu()}

    def history(self) -> Tensor | None:
        """See `Dynamics.history`: the warm start."""
        return self._view("qacc_warmstart").clone() if self._count else None

    def restore(self, history: Tensor | None, is_restored: Tensor) -> None:
        """See `Dynamics.restore`; without a history, to no warm start."""
        if not self._count:
            return
        mask, now = is_restored.to(self.device), self._view("qacc_warmstart")
        now[mask] = 0.0 if history is None else history.to(self.device)[mask]

    def _step(
        self, state: TensorDictBase, command: Tensor, terrain: Tensor | None
    ) -> dict[str, Tensor]:
        if not self._count:
            return {key: state[key].double() for key in (QPOS, QVEL)}
        is_broken = ~self._write(state, command, terrain)
        self._advance()
        moved = torch.cat((self._view(QPOS), self._view(QVEL)), -1)
        is_broken |= ~(moved.abs() <= LARGEST).all(-1) | self._has_overflown()
        self._view("qacc_warmstart")[is_broken] = 0.0
        values = {
            key: self._view(key).double().masked_fill(is_broken[:, None], torch.nan)
            for key in (QPOS, QVEL)
        }
        if self.feels_forces:
            values[SENSORDATA] = self._view("sensordata").double()
        return values

    def _write(
        self, state: TensorDictBase, command: Tensor, terrain: Tensor | None
    ) -> Tensor:
        """Put envs where they should be; returns which can be stepped, ``(num_envs,)``.

        The others stand at rest meanwhile, so that their numbers cost no other env.
        """
        qpos, qvel, told = (
            value.to(self.device, torch.float32)
            for value in (state[QPOS], state[QVEL], command)
        )
        is_sound = (torch.cat((qpos, qvel), -1).abs() <= LARGEST).all(-1)
        is_sound &= told.isfinite().all(-1)
        told = torch.where(is_sound[:, None], told, 0.0)
        rest = torch.as_tensor(self._source.qpos0, device=self.device).to(qpos)
        self._view("qpos").copy_(torch.where(is_sound[:, None], qpos, rest))
        self._view("qvel").copy_(torch.where(is_sound[:, None], qvel, 0.0))
        if self.has_actuators:
            self._view("ctrl").copy_(told)
        else:
            self._view("qfrc_applied")[:, self.scene.actuated] = told
        self._view("overflow").zero_()
        for key, value in ground_pose(self.scene, terrain).items():
            self._view(key).copy_(value)
        return is_sound

    def _has_overflown(self) -> Tensor:
        """Envs ``(num_envs,)`` that lost contacts or constraints for want of memory."""
        kinds = self._engine.OverflowType
        lost = kinds.NEFC | kinds.NJMAX_NNZ | kinds.BROADPHASE | kinds.NARROWPHASE
        return (self._view("overflow") & int(lost | kinds.CCD)) != 0

    def _view(self, name: str) -> Tensor:
        """An array of Warp's as a tensor of the same memory, ``(num_envs, ...)``."""
        return cast(Tensor, self._warp.to_torch(getattr(self._data, name)))

    def _scope(self) -> AbstractContextManager[Any]:
        """Warp's work in the order of torch's, on the same device."""
        if self.device.type != "cuda":
            return self._warp.ScopedDevice(self._place)
        return self._warp.ScopedStream(self._warp.stream_from_torch(self.device))

    def _allocate(self, count: int) -> None:
        self._graph: Any = None
        self._data: Any = None
        if not count:
            return
        contacts, source = self.max_contacts, self._source
        if contacts is None:
            of_pair = CONTACTS_PER_HEIGHT_FIELD if source.nhfield else CONTACTS_PER_PAIR
            contacts = of_pair * len(self._model.nxn_geom_pair_filtered)
        constraints = _most_constraints(source, contacts)
        with self._scope():
            self._data = self._engine.make_data(
                source,
                nworld=count,
                nconmax=contacts,
                njmax=constraints,
                njmax_nnz=constraints * source.nv,
            )

    def _advance(self) -> None:
        """One control step of all envs, replayed as a graph from the second one on."""
        if self._graph is not None:
            with self._scope():
                self._warp.capture_launch(self._graph)
            return
        with self._scope():
            self._substeps()
        can_capture = self.device.type == "cuda" and self.is_capturing
        if can_capture and self._warp.is_mempool_enabled(self._place):
            # kernels are compiled by now; torch's own stream cannot be captured
            self._warp.synchronize_device(self._place)
            with self._warp.ScopedCapture(device=self._place) as capture:
                self._substeps()
            self._graph = capture.graph

    def _substeps(self) -> None:
        for _ in range(self.scene.substeps):
            self._engine.step(self._model, self._data)


def _weaken_actuators(model: mujoco.MjModel) -> None:
    """Actuators without force in place of disabled ones, in place.

    Where they are disabled, Warp's implicit integrators leave joint damping out.
    """
    model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    model.actuator_gaintype[:] = mujoco.mjtGain.mjGAIN_FIXED
    model.actuator_biastype[:] = mujoco.mjtBias.mjBIAS_NONE
    model.actuator_gainprm[:] = 0.0


def is_warp_installed() -> bool:
    """Whether the package mujoco-warp can be imported."""
    return find_spec("mujoco_warp") is not None


def _import_warp() -> tuple[Any, Any]:
    """The modules ``warp`` and ``mujoco_warp``, without their greeting."""
    if not is_warp_installed():
        raise ModuleNotFoundError(
            "dynamics 'mujoco_warp' needs the package mujoco-warp, which is not "
            "installed: in the clone, pip install -e '.[warp]'"
        )
    is_first = "warp" not in sys.modules
    import warp

    if is_first:  # whoever imported it before has chosen what it says
        warp.config.log_level = warp.LOG_ERROR
    import mujoco_warp

    warp.init()
    return warp, mujoco_warp


def _most_constraints(model: mujoco.MjModel, contacts: int) -> int:
    """How many scalar constraints an env can have with so many contacts."""
    dims = *model.geom_condim, *model.pair_dim
    condim = int(max(dims, default=1))
    is_pyramid = model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    each = max(1, 2 * (condim - 1)) if is_pyramid else condim
    # a limit holds a joint at both ends at worst; friction loss acts on every dof
    others = 2 * (model.njnt + model.ntendon) + model.nv + model.ntendon
    others += 6 * model.neq  # of a weld, which has the most
    return each * contacts + others
