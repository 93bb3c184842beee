"""Networks that are here to be compared with, with the transformer's signature."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from torchrl_nerd.modules.linear import FullLinear
from torchrl_nerd.modules.networks import NoMemory
from torchrl_nerd.modules.transformer import (
    CausalTransformer,
    TransformerConfig,
)


@dataclass(frozen=True)
class LSTMConfig:
    """Size of an LSTM of one layer."""

    width: int = 112

    def build(self, num_inputs: int, num_outputs: int) -> "LSTM":
        """A freshly initialised network."""
        return LSTM(self, num_inputs, num_outputs)


@dataclass
class CellState:
    """Output and cell of an LSTM, ``(1, rows, width)`` each; zero is an empty history."""

    hidden: Tensor
    cell: Tensor

    def clear(self, rows: Tensor) -> None:
        """Empty the history of ``rows`` (bool ``(rows,)``), others untouched."""
        self.hidden = torch.where(rows[:, None], 0.0, self.hidden)
        self.cell = torch.where(rows[:, None], 0.0, self.cell)


class LSTM(nn.Module):
    """Long short-term memory between two linear layers, as the GRU."""

    def __init__(self, config: LSTMConfig, num_inputs: int, num_outputs: int) -> None:
        super().__init__()
        self.config = config
        self.embed = FullLinear(num_inputs, config.width)
        self.lstm = nn.LSTM(config.width, config.width, batch_first=True)
        self.head = FullLinear(config.width, num_outputs)

    def forward(self, tokens: Tensor) -> Tensor:
        """Sequences that start with an empty history: ``(rows, T, F) -> (rows, T, D)``."""
        return self.head(self.lstm(self.embed(tokens))[0])

    def empty_memory(self, rows: int) -> CellState:
        """Zeros for ``rows`` rows."""
        zero = self.embed.weight.new_zeros(1, rows, self.config.width)
        return CellState(zero, zero.clone())

    def step(self, token: Tensor, memory: CellState) -> Tensor:
        """``(rows, F) -> (rows, D)``; advances ``memory``."""
        state = memory.hidden, memory.cell
        output, (memory.hidden, memory.cell) = self.lstm(
            self.embed(token)[:, None], state
        )
        return self.head(output[:, 0])


@dataclass(frozen=True)
class MarkovConfig:
    """A transformer that sees one token, h = 1; sizes as in `TransformerConfig`."""

    layers: int = 2
    width: int = 64
    heads: int = 4

    def build(self, num_inputs: int, num_outputs: int) -> "Markov":
        """A freshly initialised network."""
        return Markov(self, num_inputs, num_outputs)


class Markov(nn.Module):
    """The transformer on sequences of one token: its attention has one thing to see."""

    def __init__(self, config: MarkovConfig, num_inputs: int, num_outputs: int) -> None:
        super().__init__()
        size = TransformerConfig(config.layers, config.width, config.heads, band=2)
        self.transformer = CausalTransformer(size, num_inputs, num_outputs)

    def forward(self, tokens: Tensor) -> Tensor:
        """``(*batch, F) -> (*batch, D)``."""
        alone = self.transformer(tokens.flatten(0, -2)[:, None])
        return alone.view(*tokens.shape[:-1], -1)

    def empty_memory(self, rows: int) -> NoMemory:
        """Nothing."""
        return NoMemory()

    def step(self, token: Tensor, memory: NoMemory) -> Tensor:
        """``(rows, F) -> (rows, D)``."""
        return self(token)
