"""What a learned step asks of the machine: arithmetic, counted, and memory."""

from dataclasses import dataclass
from itertools import chain

import torch
from tensordict import TensorDict
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from torchrl_nerd.dynamics import Dynamics, GuardedDynamics, NeRDDynamics
from torchrl_nerd.keys import QPOS, QVEL, TERRAIN
from torchrl_nerd.modules.nerd import History, Network


@dataclass(frozen=True)
class Cost:
    """One control step of one row.

    | field | meaning |
    |---|---|
    | ``flop`` | of its matrix products: two for a multiplication and its addition |
    | ``state_bytes`` | of ``qpos`` and ``qvel`` |
    | ``memory_bytes`` | of the history: keys and values, tokens or a hidden state |
    """

    flop: float
    state_bytes: int
    memory_bytes: int


def step_cost(dynamics: Dynamics, state: TensorDict) -> Cost | None:
    """Cost of a learned step, counted while it is made; None for true dynamics.

    Features count where they are matrix products (rotations); elementwise work does not.

    Args:
        dynamics: of its own for this call: it steps, and eagerly from then on.
        state: ``[rows]`` of the scene, with the ground where it varies.
    """
    learned = dynamics.learned if isinstance(dynamics, GuardedDynamics) else dynamics
    if not isinstance(learned, NeRDDynamics):
        return None
    learned.compile = False  # the counter sees no product inside compiled code
    torque = torch.zeros(len(state), len(dynamics.scene.actuated)).double()
    start = state.select(QPOS, QVEL)
    dynamics.reset(start)
    with FlopCounterMode(display=False) as counter:
        dynamics.step(start, torque, state.get(TERRAIN, None))
    return Cost(
        flop=counter.get_total_flops() / len(state),
        state_bytes=sum(state[key][0].nbytes for key in (QPOS, QVEL)),
        memory_bytes=memory_bytes(learned.network),
    )


def memory_bytes(network: Network) -> int:
    """What one more row adds to a network's history."""
    one, two = (
        sum(tensor.nbytes for tensor in _tensors(network.empty_memory(rows)))
        for rows in (1, 2)
    )
    return two - one


def _tensors(memory: History) -> list[Tensor]:
    parts = (x if isinstance(x, list) else [x] for x in vars(memory).values())
    return list(chain.from_iterable(parts))
