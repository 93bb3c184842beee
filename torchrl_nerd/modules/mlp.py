"""Multilayer perceptron with the transformer's signature: no history (Markov model)."""

from dataclasses import dataclass

from torch import Tensor, nn

from torchrl_nerd.modules.transformer import (
    FeedForward,
    FullLinear,
    initialize,
    make_head,
)


@dataclass(frozen=True)
class MLPConfig:
    """Size of an MLP: ``depth`` residual blocks of ``width``."""

    depth: int = 4
    width: int = 64

    def build(self, num_inputs: int, num_outputs: int) -> "MLP":
        """A freshly initialised network."""
        return MLP(self, num_inputs, num_outputs)


class NoMemory:
    """History of a network that has none."""

    def clear(self, rows: Tensor) -> None:
        """Nothing to forget."""


class MLP(nn.Module):
    """The transformer without its attention: a history of one (the Markov model)."""

    def __init__(self, config: MLPConfig, num_inputs: int, num_outputs: int) -> None:
        super().__init__()
        self.config = config
        self.embed = FullLinear(num_inputs, config.width)
        self.blocks = nn.ModuleList(
            FeedForward(config.width) for _ in range(config.depth)
        )
        self.head = make_head(config.width, num_outputs)
        initialize(self.blocks)

    def forward(self, tokens: Tensor) -> Tensor:
        """``(*batch, F) -> (*batch, D)``."""
        x = self.embed(tokens)
        for block in self.blocks:
            x = block(x)
        return self.head(x)

    def empty_memory(self, rows: int) -> NoMemory:
        """Nothing."""
        return NoMemory()

    def step(self, token: Tensor, memory: NoMemory) -> Tensor:
        """``(rows, F) -> (rows, D)``."""
        return self(token)
