"""A NeRD that corrects a cheap simulator step instead of replacing it.

The simulator knows that bodies do not sink into the ground; what is left to learn is small
and smooth, so that a few hundred recordings suffice. Its parameters are trained along.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from tensordict.utils import NestedKey
from torch import Tensor, nn

from torchrl_nerd.modules.baselines import MLP, MLPConfig, NoMemory
from torchrl_nerd.modules.nerd import TARGET, NeRD
from torchrl_nerd.modules.penalty_step import PenaltyStep
from torchrl_nerd.scenes.scene import Scene
from torchrl_nerd.transforms import Stats

HALF_GATE = 0.05  # m/s: pushes of that size are corrected by half of what the net says


@dataclass(frozen=True)
class ResidualConfig:
    """An MLP of ``depth`` blocks of ``width`` on a simulator step of ``substeps``."""

    depth: int = 2
    width: int = 64
    substeps: int = 8

    def build(self, num_inputs: int, num_outputs: int) -> "Correction":
        """A network that corrects nothing yet."""
        return Correction(self, num_inputs, num_outputs)


class Correction(nn.Module):
    """Adds to the simulator's change what an MLP makes of all, times the token's last.

    The simulator's change stands before that last entry, how much contact there is.
    """

    def __init__(
        self, config: ResidualConfig, num_inputs: int, num_outputs: int
    ) -> None:
        super().__init__()
        self.config, self.num_outputs = config, num_outputs
        size = MLPConfig(config.depth, config.width)
        self.mlp = MLP(size, num_inputs + num_outputs, num_outputs)  # not the gate
        last = [m for m in self.mlp.head.modules() if isinstance(m, nn.Linear)][-1]
        for weight in last.parameters():
            nn.init.zeros_(weight)

    def forward(self, tokens: Tensor) -> Tensor:
        """``(*batch, F + D + 1) -> (*batch, D)``."""
        seen, gate = tokens[..., :-1], tokens[..., -1:]
        return seen[..., -self.num_outputs :] + gate * self.mlp(seen)

    def empty_memory(self, rows: int) -> NoMemory:
        """Nothing."""
        return NoMemory()

    def step(self, token: Tensor, memory: NoMemory) -> Tensor:
        """``(rows, F + D + 1) -> (rows, D)``."""
        return self(token)


class ResidualNeRD(NeRD):
    """The learned correction of a `PenaltyStep`; otherwise a `NeRD` like any other.

    The token ends with the change that the simulator predicts, normalised as targets are,
    and with how much of it is contact, 0 to 1: free flight needs no correction, and small
    ones would add up along a toss.

    Args:
        scene: a single free body on level ground.
        config: of the network and the simulator.
        stats: as for `NeRD`.
    """

    def __init__(
        self,
        scene: Scene,
        config: ResidualConfig,
        stats: Mapping[NestedKey, Stats] | None = None,
    ) -> None:
        super().__init__(scene, config, stats)
        self.simulator = PenaltyStep(scene, config.substeps)

    def assemble(self, features: Tensor, qpos: Tensor, qvel: Tensor) -> Tensor:
        """Tokens ``(*batch, F + D + 1)``, the simulator's change among them."""
        token = super().assemble(features, qpos, qvel)
        flat = qpos.reshape(-1, qpos.shape[-1]), qvel.reshape(-1, qvel.shape[-1])
        *after, push = self.simulator(*flat)
        after = (x.view_as(y) for x, y in zip(after, (qpos, qvel), strict=True))
        change = self.state_delta.delta(qpos, qvel, *after)
        change = self.normalize.normalize(TARGET, change)
        push = push.detach().view(*qpos.shape[:-1], 1)
        gate = push / (push + HALF_GATE)
        return torch.cat((token, change.to(token.dtype), gate.to(token.dtype)), -1)

    def decode(
        self, qpos: Tensor, qvel: Tensor, output: Tensor
    ) -> tuple[Tensor, Tensor]:
        """As `NeRD`, but unbounded: the simulator knows what lies beyond the data."""
        delta = self.normalize.denormalize(TARGET, output.to(qpos.dtype))
        return self.state_delta.integrate(qpos, qvel, delta)

    def _apply(self, fn: Callable, recurse: bool = True) -> "ResidualNeRD":
        """As `NeRD`: the simulator moves but stays float64."""
        super()._apply(fn, recurse)
        for store in (self.simulator._buffers, self.simulator._parameters):
            for value in store.values():
                if value is not None:
                    value.data = value.data.to(fn(value.data).device)
        return self
