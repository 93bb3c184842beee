"""What a learned step asks of the machine: counted arithmetic and memory.

    python benchmarks/step_cost.py cartpole ant

Of every model that is shipped for a scene, one control step of one trajectory. Matrix
products count (rotations among them), elementwise work does not.
"""

from dataclasses import asdict, dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import torch
import tyro
from tensordict import TensorDict
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode
from tyro.conf import Positional

from torchrl_nerd.dynamics import Dynamics, GuardedDynamics, NeRDDynamics
from torchrl_nerd.evaluation.bench.candidates import models
from torchrl_nerd.evaluation.bench.rates import mid_states
from torchrl_nerd.evaluation.results import write_results
from torchrl_nerd.evaluation.tables import text_table
from torchrl_nerd.keys import QPOS, QVEL, TERRAIN
from torchrl_nerd.modules.history import History
from torchrl_nerd.robots import load_scene, source_of


@dataclass
class Options:
    """Which scenes' models to count."""

    scenes: Positional[tuple[str, ...]] = ("cartpole", "double_pendulum", "ant")
    seed: int = 0
    json: Path | None = None
    """Write the results to this file."""


@dataclass(frozen=True)
class Cost:
    """One control step of one trajectory.

    | field | meaning |
    |---|---|
    | ``flop`` | of its matrix products: two for a multiplication and its addition; not of
      a transformer's attention to its past, 4 band width in each layer |
    | ``state_bytes`` | of ``qpos`` and ``qvel`` |
    | ``memory_bytes`` | of the history: keys and values, tokens or a hidden state |
    """

    flop: float
    state_bytes: int
    memory_bytes: int


def step_cost(dynamics: Dynamics, state: TensorDict) -> Cost | None:
    """Cost of a learned step, counted while it is made; None for other dynamics.

    Args:
        dynamics: of its own for this call: it steps, and eagerly from then on.
        state: ``[batch]`` of the scene, with the terrain where it varies.
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


def memory_bytes(network: Any) -> int:
    """What one more trajectory adds to a network's history."""
    one, two = (
        sum(tensor.nbytes for tensor in _tensors(network.empty_memory(n)))
        for n in (1, 2)
    )
    return two - one


def _tensors(memory: History) -> list[Tensor]:
    parts = (x if isinstance(x, list) else [x] for x in vars(memory).values())
    return list(chain.from_iterable(parts))


def main(options: Options) -> list[dict]:
    """Print a line for every model; returns the rows."""
    found = []
    for name in options.scenes:
        scene = load_scene(name)
        state = mid_states(source_of(scene), 8, options.seed)
        for candidate in models(scene):
            cost = step_cost(candidate.make(scene), state)
            if cost is not None:
                about = {"name": candidate.name, "kind": candidate.kind}
                found.append(about | asdict(cost))
    columns = ["name", "kind", "flop", "state_bytes", "memory_bytes"]
    body = [[str(row[c]) for c in columns[:2]] for row in found]
    body = [
        [*line, *(f"{row[c]:,.0f}" for c in columns[2:])]
        for line, row in zip(body, found, strict=True)
    ]
    print(text_table(columns, body))
    if options.json is not None:
        write_results(options.json, found, options.seed)
    return found


if __name__ == "__main__":
    main(tyro.cli(Options))
