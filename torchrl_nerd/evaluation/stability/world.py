"""What a case steps: any dynamics of a scene, or any TorchRL env with qpos and qvel."""

from typing import Protocol, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_nerd.dynamics import Dynamics, MujocoDynamics
from torchrl_nerd.evaluation.stability.states import idle, rows_of
from torchrl_nerd.evaluation.traces import trace
from torchrl_nerd.keys import ACTION, QPOS, QVEL
from torchrl_nerd.scenes import Scene


class World(Protocol):
    """A robot that can be put anywhere and driven."""

    scene: Scene
    is_true: bool

    @property
    def dynamics(self) -> Dynamics | None:
        """What steps it; None where only an env is known."""
        ...

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
        if torque is None:
            torque = idle(self.scene, len(start))[:, None]

        def drive(step: int, state: TensorDictBase) -> Tensor:
            return torque[:, step % torque.shape[1]]

        return trace(self.dynamics, start, steps, drive, every)


class EnvWorld:
    """Any `EnvBase` that shows ``qpos`` and ``qvel`` and can be set to a state.

    Torques become actions by their share of the largest ones of the scene's sampling: a
    case means the same drive to every env, in the env's own units. More states than the
    env has rows take turns.

    Args:
        env: of one batch dimension; ``reset(td, set_state=True)`` sets its state, ``qpos``
            and ``qvel`` come back from it and from each step.
        scene: the robot it holds; its own ``scene`` where not given.
        is_true: whether the lines of true dynamics are to be kept.
    """

    def __init__(
        self, env: EnvBase, scene: Scene | None = None, is_true: bool = False
    ) -> None:
        self.env, self.is_true = env, is_true
        self.scene = cast(Scene, env.scene if scene is None else scene)
        self.dynamics = None

    def roll(
        self,
        start: TensorDict,
        steps: int,
        torque: Tensor | None = None,
        every: int = 1,
    ) -> TensorDict:
        """See `World.roll`; ends of episodes are stepped over."""
        count, parts = self.env.batch_size.numel(), []
        for first in range(0, len(start), count):
            # the last state stands in the rows that are left over
            rows = torch.arange(first, first + count).clamp_max(len(start) - 1)
            drive = None if torque is None else torque[rows]
            parts.append(self._roll(rows_of(start, rows), steps, drive, every))
        return cast(TensorDict, torch.cat(parts)[: len(start)])

    def _roll(
        self, start: TensorDict, steps: int, torque: Tensor | None, every: int
    ) -> TensorDict:
        """As many states as the env has rows."""
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
