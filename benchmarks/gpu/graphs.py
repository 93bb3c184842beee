"""Steps in place, so that a CUDA graph can replay them; bf16 inside a network."""

import copy
from collections.abc import Callable
from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from torchrl_nerd.dynamics import NeRDDynamics
from torchrl_nerd.dynamics.models import TorchDynamics
from torchrl_nerd.envs.base import SceneEnv
from torchrl_nerd.envs.streams import uniforms
from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.modules.kv_cache import KeyValueCache
from torchrl_nerd.modules.linear import FullLinear
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.training.capture import capture


class InPlaceStep:
    """Steps a dynamics from its own last state, in memory that stays.

    Args:
        dynamics: learned, hybrid or analytic; eager or compiled.
        state: ``[n]``, copied.
        joint_torque: ``(n, num_actuated)``, held.
    """

    def __init__(
        self, dynamics: TorchDynamics, state: TensorDictBase, joint_torque: Tensor
    ) -> None:
        self.dynamics, self.joint_torque = dynamics, joint_torque
        self.terrain = state.get("terrain", None)
        self.state = state.select(QPOS, QVEL).clone()
        dynamics.reset(self.state)

    @torch.no_grad()
    def __call__(self) -> None:
        """One control step of all."""
        after = self.dynamics.step(self.state, self.joint_torque, self.terrain)
        for key in (QPOS, QVEL):
            self.state[key].copy_(after[key])


class InPlaceEnv:
    """A whole env step, with resets by mask, in memory that stays.

    Controller, model, faults, reward, observation, end, random numbers of resets and the
    reset itself; nothing is asked of the device. The env's own state is the one that moves.

    Args:
        env: of a learned, hybrid or analytic model; just reset.
        action: ``(num_envs, num_actions)``, read anew at every step.
    """

    def __init__(self, env: SceneEnv, action: Tensor) -> None:
        self.env, self.action = env, action
        self.state = {key: value.clone() for key, value in env._state().items()}
        self.age, self.episode = env._age.clone(), env._episode.clone()
        self.done = torch.zeros_like(self.age, dtype=torch.bool)
        self.observation = env.task.observation(self.state).to(torch.float32)
        self.reward = torch.zeros_like(self.observation[:, :1])

    @torch.no_grad()
    def __call__(self) -> None:
        """One action of all, then a reset of those that are done."""
        env = self.env
        found = env._transit(self.state, self.action, self.age)
        self.reward.copy_(found["reward"])
        self.done.copy_(found["done"][:, 0])
        moved = {key: found[key] for key in self.state}
        drawn = uniforms(env._keys, self.episode, env._offsets, moved[QPOS].dtype)
        start = env._restart(moved, self.done, drawn, {})
        for key, value in self.state.items():
            value.copy_(start[key])
        kept = torch.where(
            self.done[:, None], start["observation"], found["observation"]
        )
        self.observation.copy_(kept)
        self.age.add_(1).masked_fill_(self.done, 0)
        self.episode.add_(self.done)
        state = TensorDict(self.state, self.done.shape)
        env.dynamics.reset(state, self.done)


def graphed(step: Callable[[], None], device: torch.device) -> Callable[[], object]:
    """A CUDA graph of a step in place; on another device the step itself.

    Raises:
        RuntimeError: the step asks the device for a number, or makes it wait.
    """
    if device.type != "cuda":
        return step
    return capture(step, device)[0].replay


class Bfloat16(nn.Module):
    """A network whose inner matrices and history are bfloat16, its ends float32.

    Products are summed in float32 by the matrix units. The same signature as the network's.

    Args:
        network: copied; its own weights stay.
    """

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network: Any = copy.deepcopy(network)
        for module in self.network.modules():
            if isinstance(module, nn.Linear) and not isinstance(module, FullLinear):
                module.bfloat16()
        self.device = next(network.parameters()).device.type

    def empty_memory(self, rows: int) -> Any:
        """The network's own; keys and values in bfloat16."""
        memory = self.network.empty_memory(rows)
        if isinstance(memory, KeyValueCache):
            memory.keys = [x.bfloat16() for x in memory.keys]
            memory.values = [x.bfloat16() for x in memory.values]
        return memory

    def step(self, token: Tensor, memory: Any) -> Tensor:
        """``(rows, F) -> (rows, D)``, float32."""
        with torch.autocast(self.device, torch.bfloat16):
            return self.network.step(token, memory).float()


def half(model: NeRD, **how: Any) -> NeRDDynamics:
    """Dynamics of a model whose network computes in `Bfloat16`; state and ends do not."""
    dynamics = NeRDDynamics(model, **how)
    dynamics.network = Bfloat16(cast(nn.Module, dynamics.network))
    return dynamics
