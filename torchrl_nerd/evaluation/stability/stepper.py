"""What a case steps: any dynamics of a scene, or any TorchRL env with qpos and qvel."""

from abc import ABC, abstractmethod
from typing import cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_nerd.dynamics import Dynamics, MujocoDynamics
from torchrl_nerd.evaluation.stability.states import zero_torque
from torchrl_nerd.evaluation.traces import trace
from torchrl_nerd.keys import ACTION, QPOS, QVEL
from torchrl_nerd.scenes import Scene


class Stepper(ABC):
    """A robot that can be put into any state and driven.

    | attribute | meaning |
    |---|---|
    | ``scene`` | the robot |
    | ``dynamics`` | what steps it; None where only an env is known |
    | ``is_ground_truth`` | whether MuJoCo steps it |
    """

    scene: Scene
    dynamics: Dynamics | None = None
    is_ground_truth: bool

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
            torque = zero_torque(self.scene, len(start))[:, None]
        return self._roll(start, steps, torque, every)

    @abstractmethod
    def _roll(
        self, start: TensorDict, steps: int, torque: Tensor, every: int
    ) -> TensorDict: ...


class DynamicsStepper(Stepper):
    """A `Dynamics`, driven by joint torques."""

    def __init__(self, dynamics: Dynamics) -> None:
        self.dynamics, self.scene = dynamics, dynamics.scene
        self.is_ground_truth = isinstance(dynamics, MujocoDynamics)

    def _roll(
        self, start: TensorDict, steps: int, torque: Tensor, every: int
    ) -> TensorDict:
        def drive(step: int, state: TensorDictBase) -> Tensor:
            return torque[:, step % torque.shape[1]]

        return trace(cast(Dynamics, self.dynamics), start, steps, drive, every)


class EnvStepper(Stepper):
    """Any `EnvBase` that has ``qpos`` and ``qvel`` and can be set to a state.

    A torque becomes an action by its fraction of the largest torque of the scene's
    sampling. More states than the env has envs are stepped one batch after another; ends
    of episodes are ignored.

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

    def _roll(
        self, start: TensorDict, steps: int, torque: Tensor, every: int
    ) -> TensorDict:
        count, parts = self.env.batch_size.numel(), []
        for first in range(0, len(start), count):
            # the last state fills the envs that are left over
            index = torch.arange(first, first + count).clamp_max(len(start) - 1)
            batch = cast(TensorDict, start[index])
            parts.append(self._roll_batch(batch, steps, torque[index], every))
        return cast(TensorDict, torch.cat(parts)[: len(start)])

    def _roll_batch(
        self, start: TensorDict, steps: int, torque: Tensor, every: int
    ) -> TensorDict:
        """As many states as there are envs."""
        largest = torch.tensor(self.scene.sampling.torque, dtype=torch.float64)
        state = self.env.reset(start.clone(), set_state=True)
        kept = [state.select(QPOS, QVEL)]
        action = self.env.full_action_spec[ACTION].zero()
        for step in range(steps):
            if action.shape[-1] == len(largest):
                fraction = torque[:, step % torque.shape[1]] / largest
                action = fraction.to(action.dtype)
            state[ACTION] = action
            state = self.env.step(state)["next"]
            if (step + 1) % every == 0:
                kept.append(state.select(QPOS, QVEL))
        return cast(TensorDict, torch.stack(kept, 1))
