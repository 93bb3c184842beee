"""MLP and GRU with the transformer's signature, and all networks by name.

The MLP has no history (a Markov model); the GRU's history is a hidden state.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from torchrl_nerd.modules.linear import FullLinear
from torchrl_nerd.modules.transformer import (
    FeedForward,
    TransformerConfig,
    initialize,
    make_head,
    stored,
)
from torchrl_nerd.settings import SettingError, look_up


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

    def restore(self, past: "NoMemory", rows: Tensor) -> None:
        """Nothing to remember."""


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
        x = self.embed(tokens)  # (*batch, width)
        for block in self.blocks:
            x = block(x)
        return self.head(x)

    def empty_memory(self, rows: int) -> NoMemory:
        """Nothing."""
        return NoMemory()

    def step(self, token: Tensor, memory: NoMemory) -> Tensor:
        """``(rows, F) -> (rows, D)``."""
        return self(token)


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
    """Hidden state of a GRU; zero is an empty history."""

    value: Tensor  # (layers, rows, width)

    def clear(self, rows: Tensor) -> None:
        """See `History.clear`."""
        self._put(rows, 0.0)

    def __copy__(self) -> "HiddenState":
        """Apart from the original, which is written to in place."""
        return HiddenState(self.value.clone())

    def restore(self, past: "HiddenState", rows: Tensor) -> None:
        """See `History.restore`."""
        self._put(rows, past.value)

    def _put(self, rows: Tensor, value: Tensor | float) -> None:
        value = torch.where(rows[:, None], value, self.value)
        self.value = stored(self.value, value)


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
        inputs = self.embed(tokens).to(next(self.gru.parameters()).dtype)
        return self.head(self.gru(inputs)[0])

    def empty_memory(self, rows: int) -> HiddenState:
        """A hidden state of zeros for ``rows`` rows."""
        shape = (self.config.layers, rows, self.config.width)
        return HiddenState(next(self.gru.parameters()).new_zeros(shape))

    def step(self, token: Tensor, memory: HiddenState) -> Tensor:
        """``(rows, F) -> (rows, D)``; advances ``memory``."""
        # (rows, 1, width)
        inputs = self.embed(token)[:, None].to(next(self.gru.parameters()).dtype)
        output, value = self.gru(inputs, memory.value)
        memory.value = stored(memory.value, value)
        return self.head(output[:, 0])


NetworkConfig = TransformerConfig | MLPConfig | GRUConfig

TRANSFORMERS = {
    "transformer-2x64": TransformerConfig(2, 64, 4),
    "transformer-2x96": TransformerConfig(2, 96, 4),
    "adaptive-4x64": TransformerConfig(4, 64, 4, band=64, pairs=True),
    "transformer-4x128": TransformerConfig(4, 128, 4),
    "paper": TransformerConfig(6, 192, 12),
    "paper-large": TransformerConfig(6, 384, 12),
}
NETWORKS: dict[str, NetworkConfig] = {
    **TRANSFORMERS,
    "mlp-1x16": MLPConfig(depth=1, width=16),
    "mlp-1x32": MLPConfig(depth=1, width=32),
    "mlp-2x32": MLPConfig(depth=2, width=32),
    "mlp-2x64": MLPConfig(depth=2, width=64),
    "mlp-4x64": MLPConfig(),
    "mlp-4x120": MLPConfig(depth=4, width=120),
    "mlp-4x128": MLPConfig(depth=4, width=128),
    "mlp-4x160": MLPConfig(depth=4, width=160),
    "gru": GRUConfig(),
}
"""Kind, then depth x width; ``adaptive``: a transformer for hidden parameters."""


def network_config(name: str) -> NetworkConfig:
    """The network of that name in `NETWORKS`; ``"transformer-2x64@64"`` has a band of 64.

    Raises:
        SettingError: no such network, or a band of another one.
    """
    kind, _, band = name.partition("@")
    config = look_up("network", kind, NETWORKS)
    if not band:
        return config
    if not isinstance(config, TransformerConfig) or not band.isdecimal():
        raise SettingError(f"expected a transformer and its band, got '{name}'")
    return replace(config, band=int(band))
