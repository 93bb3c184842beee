"""An env without a state of its own, as planners want it."""

from typing import cast

import torch
from tensordict import TensorDictBase
from torchrl.data import Bounded, Unbounded
from torchrl.envs import EnvBase

from torchrl_nerd.envs.base import SceneEnv


class StatelessEnv(EnvBase):
    """Steps from the state that the tensordict holds, whatever its batch size.

    For TorchRL's planners (`CEMPlanner`, `MPPIPlanner`), which try many actions from one
    state. A view of a `SceneEnv`: a tensordict of another state than it was left in sets
    that state, with an empty history; one that it has just returned goes on, with its
    history. A reset begins episodes as in ``env``; without a tensordict, all of them.
    Rollouts that drop ended elements (``break_when_all_done``) change their number, which
    an ``env`` cannot.

    Args:
        env: what steps; every tensordict has ``num_envs`` elements, such as states to
            plan for times candidates.

    Examples:
        >>> from torchrl_nerd.envs import make_env
        >>> env = StatelessEnv(make_env("cartpole/swingup", num_envs=6))
        >>> start = env.reset().reshape(2, 3)
        >>> env.rollout(5, auto_reset=False, tensordict=start)["next", "qpos"].shape
        torch.Size([2, 3, 5, 2])
    """

    batch_locked = False  # pyright: ignore

    def __init__(self, env: SceneEnv) -> None:
        super().__init__(device=env.device, batch_size=torch.Size([]))
        self.env = env
        self.observation_spec = env.observation_spec[0]  # of one env
        self.action_spec = cast(Bounded, env.action_spec)[0]
        self.reward_spec = cast(Unbounded, env.reward_spec)[0]
        self.full_done_spec = env.full_done_spec[0]

    def _set_seed(self, seed: int | None) -> None:
        self.env._set_seed(seed)

    def _reset(
        self, tensordict: TensorDictBase | None = None, **kwargs: object
    ) -> TensorDictBase:
        given = None if tensordict is None else tensordict.reshape(-1).copy()
        after = self.env.reset(given)
        return after if tensordict is None else after.reshape(tensordict.shape)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        given = tensordict.reshape(-1)  # [num_envs]
        state = self.env._state()
        if not all(torch.equal(given[key], value) for key, value in state.items()):
            self.env.reset(given.exclude("_reset"), set_state=True)
        elif any(given[key].requires_grad for key in state):  # gradients reach these
            self.env._buffers.update({f"_state_{key}": given[key] for key in state})
        return self.env._step(given).reshape(tensordict.shape)
