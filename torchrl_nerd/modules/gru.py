"""Gated recurrent unit with the transformer's signature: its history is a hidden state."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from torchrl_nerd.modules.transformer import FullLinear


@dataclass(frozen=True)
class GRUConfig:
    """Size of a GRU: ``layers`` of ``width``."""

    layers: int = 1
    width: int = 128

    def build(self, num_inputs: int, num_outputs: int) -> "GRU":
        """A freshly initialised network."""
        return GRU(self, num_inputs, num_outputs)


@dataclass
class HiddenState:
    """Hidden state of a GRU, ``(layers, rows, width)``; zero is an empty history."""

    value: Tensor

    def clear(self, rows: Tensor) -> None:
        """Empty the history of ``rows`` (bool mask ``(num_rows,)``), others untouched."""
        self.value = torch.where(rows[:, None], 0.0, self.value)


class GRU(nn.Module):
    """Gated recurrent unit between two linear layers."""

    def __init__(self, config: GRUConfig, num_inputs: int, num_outputs: int) -> None:
        super().__init__()
        self.config = config
        self.embed = FullLinear(num_inputs, config.width)
        self.gru = nn.GRU(config.width, config.width, config.layers, batch_first=True)
        self.head = FullLinear(config.width, num_outputs)

    def forward(self, tokens: Tensor) -> Tensor:
        """Sequences that start with an empty history: ``(rows, T, F) -> (rows, T, D)``."""
        return self.head(self.gru(self.embed(tokens))[0])

    def empty_memory(self, rows: int) -> HiddenState:
        """A hidden state of zeros for ``rows`` rows."""
        config = self.config
        shape = (config.layers, rows, config.width)
        return HiddenState(self.embed.weight.new_zeros(shape))

    def step(self, token: Tensor, memory: HiddenState) -> Tensor:
        """``(rows, F) -> (rows, D)``; advances ``memory``."""
        output, memory.value = self.gru(self.embed(token)[:, None], memory.value)
        return self.head(output[:, 0])
