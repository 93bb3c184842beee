"""The interface of all dynamics: state, torque and controls in, next state out."""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, Protocol

import mujoco
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_nerd.compiled import uncompiled
from torchrl_nerd.keys import (
    ACTION,
    CTRL,
    JOINT_TORQUE,
    PARAMETERS,
    QPOS,
    QVEL,
    TERRAIN,
)
from torchrl_nerd.scenes.controllers import ActuatorController
from torchrl_nerd.scenes.scene import Scene
from torchrl_nerd.scenes.variation import Ranges


class Dynamics(Protocol):
    """What an env needs of physics. A state holds ``qpos`` and ``qvel``, float64.

    The next state is on the device of the state before, wherever the dynamics computes.
    ``kind`` is ``"ground truth"``, ``"learned"``, ``"hybrid"`` or ``"analytic"``. A
    subclass that keeps no past has `step` alone to give. A model that is told
    parameters has their ranges as ``told``.
    """

    scene: Scene
    kind: str
    told: Ranges | None = None

    def __init__(self, scene: Scene) -> None:
        self.scene = scene

    def reset(self, state: TensorDictBase, is_reset: Tensor | None = None) -> None:
        """Forget the past of the envs that start anew.

        ``is_reset (num_envs,)`` is True for these; None stands for all envs.
        """

    def history(self) -> Any:
        """A copy of the past that is kept of all envs, for `restore`."""

    def restore(self, history: Any, is_restored: Tensor) -> None:
        """Give envs back the past that they had at `history`.

        ``is_restored (num_envs,)`` is True for these.
        """

    def step(
        self,
        state: TensorDictBase,
        joint_torque: Tensor,
        terrain: Tensor | None = None,
        ctrl: Tensor | None = None,
    ) -> TensorDictBase:
        """The state one control step later.

        Args:
            state: ``qpos (num_envs, nq)``, ``qvel (num_envs, nv)`` and, where the scene
                varies, ``parameters``, which the next state has too.
            joint_torque: ``(num_envs, num_actuated)``, N and N m, held over the step; with
                ``ctrl``, that of its start.
            terrain: ``(num_envs, terrain.size)`` where the ground varies.
            ctrl: ``(num_envs, nu)``, held over the step: the ground truth steps with
                MuJoCo's own actuators, and a model of servos knows them by it.

        Returns:
            A new tensordict; envs that the physics could not step are not finite. The
            ground truth of a model that senses forces adds ``sensordata``.
        """
        raise NotImplementedError


def warm_up(
    dynamics: Dynamics,
    history: TensorDictBase,
    num_envs: int,
    advance: Callable[[TensorDictBase, TensorDictBase], Any] | None = None,
) -> None:
    """Give a dynamics the past that a recorded motion has; what it had is forgotten.

    A rollout from the state after the motion then starts adapted to what the motion shows;
    the ground truth learns of late torques. ``history [num_envs, T]``, oldest first, holds
    ``qpos``, ``qvel``, ``("next", "joint_torque")`` and, where there are any, ``ctrl``,
    ``terrain`` and ``parameters``. Where it holds the end of an episode
    (``("next", "done")``), the past of that env begins anew. ``advance`` makes a step of
    the motion from its state; by default the dynamics does, with the torque.

    Raises:
        ValueError: another number of envs, no step at all, a key that is missing (of the
            ground truth, ``parameters`` too where they vary), or numbers not finite.
    """
    size = list(history.batch_size)
    if len(size) != 2 or size[0] != num_envs or not size[1]:
        raise ValueError(
            f"expected a history of {num_envs} envs and at least one step, got {size}"
        )
    is_varied = dynamics.scene.variation is not None and isinstance(dynamics, Engine)
    optional = (CTRL,) if is_varied else (CTRL, PARAMETERS)
    for key in (QPOS, QVEL, JOINT_TORQUE, CTRL, PARAMETERS, ACTION):
        value = history.get(key, None)
        if value is None and key not in (*optional, ACTION):
            raise ValueError(f"expected {key!r} in a history to warm up with, got none")
        if value is not None and not value.isfinite().all():
            raise ValueError(
                f"expected finite {key!r} in a history, got NaN or infinity"
            )
    ended = None  # envs whose episode was over, (num_envs, 1)
    for step, then in enumerate(history.unbind(1)):
        state = then.select(QPOS, QVEL, PARAMETERS, strict=False)
        if step == 0:
            dynamics.reset(state)
        given = (then.get(key, None) for key in (JOINT_TORQUE, TERRAIN, CTRL))
        if ended is not None and ended.any():
            dynamics.reset(state, ended.reshape(num_envs))
        ended = then.get(("next", "done"), None)
        if advance is None:
            dynamics.step(state, *given)
        else:
            advance(state, then)
    if ended is not None and ended.any():  # what follows is another episode
        last = history.unbind(1)[-1].select(QPOS, QVEL, PARAMETERS, strict=False)
        dynamics.reset(last, ended.reshape(num_envs))


class Engine(Dynamics):
    """The ground truth.

    With ``ctrl`` the robot's own actuators act in every substep. Without it they are off,
    and the joint torque is held. A copy, such as one in another process, makes what it
    steps with anew and goes on with the same past.

    Args:
        scene: robot, ground and substeps.
        options: what else a copy is made of.
    """

    kind = "ground truth"

    def __init__(self, scene: Scene, *options: Any) -> None:
        super().__init__(scene)
        self._made_of = scene, *options
        self._count = 0  # envs that there is room for
        self.has_actuators = isinstance(scene.controller, ActuatorController)
        # sensors that need forces, such as touch
        self.feels_forces = mujoco.mjtStage.mjSTAGE_ACC in scene.model.sensor_needstage

    def __getstate__(self) -> dict[str, Any]:
        """What it is made of, and the past."""
        kept = {"has_actuators": self.has_actuators, "count": self._count}
        return {"made_of": self._made_of, "past": self.history(), **kept}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(*state["made_of"])
        self._switch(state["has_actuators"])
        self._fit(state["count"])
        self.restore(state["past"], torch.ones(self._count, dtype=torch.bool))

    def reset(self, state: TensorDictBase, is_reset: Tensor | None = None) -> None:
        """See `Dynamics.reset`."""
        self._fit(len(state[QPOS]))
        every = torch.ones(self._count, dtype=torch.bool)
        self.restore(None, every if is_reset is None else is_reset)

    @torch.no_grad()
    @uncompiled
    def step(
        self,
        state: TensorDictBase,
        joint_torque: Tensor,
        terrain: Tensor | None = None,
        ctrl: Tensor | None = None,
    ) -> TensorDictBase:
        """See `Dynamics.step`. Envs that cannot be stepped come back as NaN."""
        check_step(self.scene, state, joint_torque, terrain, ctrl)
        command = self._command(joint_torque, ctrl)
        values = self._step(state, command, terrain)
        if PARAMETERS in state.keys():
            values[PARAMETERS] = state[PARAMETERS]
        return TensorDict(values, [len(command)]).to(state[QPOS].device)

    def _command(self, joint_torque: Tensor | None, ctrl: Tensor | None) -> Tensor:
        """What is held; there is then room for it, and actuators are on or off."""
        command = joint_torque if ctrl is None else ctrl
        if command is None:
            raise ValueError("expected a joint torque or ctrl, got neither")
        self._switch(ctrl is not None)
        self._fit(len(command))
        return command

    def _switch(self, has_actuators: bool) -> None:
        if self.has_actuators != has_actuators:
            self.has_actuators = has_actuators
            self._restart()

    def _fit(self, count: int) -> None:
        if self._count != count:
            self._allocate(count)
            self._count = count

    def _restart(self) -> None:
        """Begin anew, with or without actuators."""
        self._allocate(0)
        self._count = 0

    @abstractmethod
    def _allocate(self, count: int) -> None:
        """Room for so many envs, which have no past."""

    @abstractmethod
    def _step(
        self, state: TensorDictBase, command: Tensor, terrain: Tensor | None
    ) -> dict[str, Tensor]:
        """Next ``qpos`` and ``qvel``, and ``sensordata`` where the model feels forces."""


def as_numpy(x: Tensor) -> np.ndarray:
    """The numbers of a tensor on any device, float64, without its gradients."""
    return x.detach().cpu().double().numpy()


def check_step(
    scene: Scene,
    state: TensorDictBase,
    joint_torque: Tensor | None,
    terrain: Tensor | None,
    ctrl: Tensor | None = None,
) -> None:
    """Raise ValueError where a shape is not the scene's, naming got and expected.

    So does a ground that is not finite: unlike a state, it never becomes so by itself.
    """
    num_envs = state.batch_size[0] if state.batch_size else state[QPOS].shape[0]
    if scene.terrain is not None and scene.terrain.is_per_env:
        if terrain is None:
            raise ValueError(
                f"scene '{scene.name}' has a ground per env: got no terrain"
            )
        scene.terrain.check(terrain, (num_envs, scene.terrain.size))
    for name, value, width in (
        (QPOS, state[QPOS], scene.model.nq),
        (QVEL, state[QVEL], scene.model.nv),
        ("joint_torque", joint_torque, len(scene.actuated)),
        ("ctrl", ctrl, scene.model.nu),
    ):
        expected = num_envs, width
        if value is not None and value.shape != expected:
            got = tuple(value.shape)
            raise ValueError(f"expected {name} of shape {expected}, got {got}")


def refuse_variation(scene: Scene, engine: str) -> None:
    """Raise ValueError where the scene's parameters differ from env to env."""
    if scene.variation is not None:
        raise ValueError(
            f"expected MuJoCo for the varied scene '{scene.name}', got {engine}, which "
            "steps one robot"
        )


def ground_pose(scene: Scene, terrain: Tensor | None) -> dict[str, Tensor]:
    """`Terrain.mocap_pose` as ``mocap_pos (*batch, n, 3)`` and ``mocap_quat``.

    Empty where the ground does not vary.
    """
    ground, size = scene.terrain, 3 * scene.model.nmocap
    if terrain is None or ground is None or not ground.is_per_env:
        return {}
    pose = ground.mocap_pose(terrain.double())
    pos, quat = pose[..., :size], pose[..., size:]
    return {
        "mocap_pos": pos.unflatten(-1, (-1, 3)),
        "mocap_quat": quat.unflatten(-1, (-1, 4)),
    }
