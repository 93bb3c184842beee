"""What a case steps: any dynamics of a scene, or any TorchRL env with qpos and qvel."""

from abc import ABC, abstractmethod
from typing import cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_nerd.dynamics import (
    AnalyticDynamics,
    Dynamics,
    MujocoDynamics,
    NeRDDynamics,
)
from torchrl_nerd.keys import ACTION, QPOS, QVEL, TERRAIN
from torchrl_nerd.scenes import Scene


class Stepper(ABC):
    """A robot that can be put into any state and driven.

    | attribute | meaning |
    |---|---|
    | ``scene`` | the robot |
    | ``dynamics`` | what steps it; None where only an env is known |
    | ``is_ground_truth`` | whether MuJoCo steps it |
    | ``batch`` | states stepped together; None: as many as there are |
    """

    scene: Scene
    is_ground_truth: bool
    dynamics: Dynamics | None = None
    batch: int | None = None

    def roll(
        self,
        start: TensorDict,
        steps: int,
        torque: Tensor | None = None,
        every: int = 1,
    ) -> TensorDict:
        """States ``[n, 1 + steps // every]``, the start first.

        Args:
            start: ``[n]``: ``qpos``, ``qvel`` and, where the ground varies, ``terrain``.
            steps: control steps.
            torque: ``(n, T, num_actuated)``, repeated after T steps; None for zero.
            every: steps between two states that are kept.
        """
        if torque is None:
            torque = torch.zeros(len(start), 1, len(self.scene.actuated)).double()
        count, parts = self.batch or len(start), []
        for first in range(0, len(start), count):
            # the last state fills the envs that are left over
            index = torch.arange(first, first + count).clamp_max(len(start) - 1)
            drive = torque[index]  # (batch, T, num_actuated)
            state = self._reset(cast(TensorDict, start[index]))
            kept = [state.select(QPOS, QVEL)]
            for step in range(steps):
                state = self._step(state, drive[:, step % drive.shape[1]])
                if (step + 1) % every == 0:
                    kept.append(state.select(QPOS, QVEL))
            parts.append(torch.stack(kept, 1))
        return cast(TensorDict, torch.cat(parts)[: len(start)])

    @abstractmethod
    def _reset(self, start: TensorDict) -> TensorDictBase:
        """The state at the start."""

    @abstractmethod
    def _step(self, state: TensorDictBase, torque: Tensor) -> TensorDictBase:
        """The next state."""


class DynamicsStepper(Stepper):
    """A `Dynamics`, driven by joint torques."""

    dynamics: Dynamics

    def __init__(self, dynamics: Dynamics) -> None:
        self.dynamics, self.scene = dynamics, dynamics.scene
        self.is_ground_truth = isinstance(dynamics, MujocoDynamics)
        self._terrain: Tensor | None = None

    def in_scene(self, scene: Scene) -> "DynamicsStepper":
        """The same dynamics, with the same weights, in another scene.

        Raises:
            RuntimeError: a model that was trained on another kind of ground.
        """
        dynamics = self.dynamics
        if isinstance(dynamics, AnalyticDynamics):
            step = dynamics.analytic_step.with_terrain(scene)
            return DynamicsStepper(AnalyticDynamics(step))
        if not isinstance(dynamics, NeRDDynamics):
            return DynamicsStepper(MujocoDynamics(scene))
        model = dynamics.model.copy_for(scene)
        model.load_state_dict(dynamics.model.state_dict())
        return DynamicsStepper(NeRDDynamics(model.to(dynamics.model.device)))

    def _reset(self, start: TensorDict) -> TensorDictBase:
        self._terrain, state = start.get(TERRAIN, None), start.select(QPOS, QVEL)
        self.dynamics.reset(state)
        return state

    def _step(self, state: TensorDictBase, torque: Tensor) -> TensorDictBase:
        return self.dynamics.step(state, torque, self._terrain)


class EnvStepper(Stepper):
    """Any `EnvBase` that has ``qpos`` and ``qvel`` and can be set to a state.

    A torque becomes an action by its fraction of the largest torque of the scene's
    sampling. Ends of episodes are ignored.

    Args:
        env: of one batch dimension; ``reset(td, set_state=True)`` sets its state, ``qpos``
            and ``qvel`` come back from it and from each step.
        scene: the robot it holds; its own ``scene`` where not given.
        is_ground_truth: whether the tolerances of MuJoCo apply.
    """

    def __init__(
        self, env: EnvBase, scene: Scene | None = None, is_ground_truth: bool = False
    ) -> None:
        self.env, self.is_ground_truth = env, is_ground_truth
        self.scene = cast(Scene, env.scene if scene is None else scene)
        self.batch = env.batch_size.numel()

    def _reset(self, start: TensorDict) -> TensorDictBase:
        return self.env.reset(start.clone(), set_state=True)

    def _step(self, state: TensorDictBase, torque: Tensor) -> TensorDictBase:
        largest = torch.tensor(self.scene.sampling.torque, dtype=torch.float64)
        action = self.env.full_action_spec[ACTION].zero()
        if action.shape[-1] == len(largest):
            action = (torque / largest).to(action.dtype)
        return self.env.step(state.set(ACTION, action))["next"]
