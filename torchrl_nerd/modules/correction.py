"""Networks that add to a simulator's change of the state, and zero when they are fresh."""

from dataclasses import dataclass

from torch import Tensor, nn

from torchrl_nerd.modules.baselines import MLP, MLPConfig, NoMemory


@dataclass(frozen=True)
class CorrectionConfig:
    """An MLP of ``depth`` blocks of ``width`` on a simulator's step."""

    depth: int = 2
    width: int = 64

    def build(self, num_inputs: int, num_outputs: int) -> "Correction":
        """A network that corrects nothing yet."""
        return Correction(self, num_inputs, num_outputs)


@dataclass(frozen=True)
class ResidualConfig(CorrectionConfig):
    """On ``substeps`` of a penalty simulator."""

    substeps: int = 8


@dataclass(frozen=True)
class FreeConfig(CorrectionConfig):
    """On a step along the free motion."""

    width: int = 32


@dataclass(frozen=True)
class GroundedConfig(CorrectionConfig):
    """On a step along a robot's springs, see `GroundStep`."""

    looks: int = 2
    stride: int = 1
    parts: int = 1


class Correction(nn.Module):
    """Adds to the simulator's change what an MLP makes of all, times the token's last.

    The simulator's change stands before that last entry, how much there is to correct.

    Args:
        config: depth and width of the MLP.
        num_inputs: width F of what a network sees beside the simulator's change.
        num_outputs: width D of changes.
    """

    def __init__(
        self, config: CorrectionConfig, num_inputs: int, num_outputs: int
    ) -> None:
        super().__init__()
        self.num_outputs = num_outputs
        size = MLPConfig(config.depth, config.width)
        self.mlp = MLP(size, num_inputs + num_outputs, num_outputs)  # not the gate
        last = [m for m in self.mlp.head.modules() if isinstance(m, nn.Linear)][-1]
        for weight in last.parameters():
            nn.init.zeros_(weight)

    def forward(self, tokens: Tensor) -> Tensor:
        """``(*batch, F + D + 1) -> (*batch, D)``."""
        seen, gate = tokens[..., :-1], tokens[..., -1:]
        added = self.mlp(seen.to(self.mlp.embed.weight.dtype))
        return seen[..., -self.num_outputs :] + gate * added

    def empty_memory(self, rows: int) -> NoMemory:
        """Nothing."""
        return NoMemory()

    def step(self, token: Tensor, memory: NoMemory) -> Tensor:
        """``(rows, F + D + 1) -> (rows, D)``."""
        return self(token)
