"""MLP and GRU with the transformer's signature, and all networks by name.

The MLP has no history (a Markov model); the GRU's history is a hidden state.
"""

from dataclasses import asdict, dataclass, replace

from torch import Tensor, nn

from torchrl_nerd.modules.history import History, stored
from torchrl_nerd.modules.linear import FullLinear
from torchrl_nerd.modules.products import make_products
from torchrl_nerd.modules.symmetric import make_embedding, make_head
from torchrl_nerd.modules.transformer import FeedForward, TransformerConfig, initialize
from torchrl_nerd.settings import SettingError, expect_count, look_up


@dataclass(frozen=True)
class MLPConfig:
    """Size of an MLP: ``depth`` residual blocks of ``width``."""

    depth: int = 4
    width: int = 64
    products: bool = False  # of features, see `products`
    symmetries: int = 1  # mirrors of the robot and their products; see `symmetric`
    asymmetry: bool = False  # has them but nearly; see `Embedding`

    def build(self, num_inputs: int, num_outputs: int) -> "MLP":
        """A freshly initialised network."""
        return MLP(self, num_inputs, num_outputs)


class NoMemory(History):
    """History of a network that has none."""


class MLP(nn.Module):
    """The transformer without its attention: a history of one (the Markov model)."""

    def __init__(self, config: MLPConfig, num_inputs: int, num_outputs: int) -> None:
        super().__init__()
        expect_count(0, depth=config.depth)
        expect_count(1, width=config.width)
        self.config = config
        sizes = config.width, config.symmetries
        self.embed = make_embedding(num_inputs, *sizes, asymmetry=config.asymmetry)
        self.blocks = nn.ModuleList(FeedForward(*sizes) for _ in range(config.depth))
        self.head = make_head(config.width, num_outputs, config.symmetries)
        self.products = make_products(config.products, num_inputs, num_outputs, *sizes)
        initialize(self.blocks)

    def forward(self, tokens: Tensor) -> Tensor:
        """``(*batch, F) -> (*batch, D)``."""
        # (*batch, *hidden) both
        x, factors = self.products.enter(self.embed(tokens), tokens)
        for block in self.blocks:
            x = block(x)
        return self.products.leave(self.head(x), x, factors)

    def read(self, tokens: Tensor, memory: NoMemory) -> Tensor:
        """``(rows, T, F) -> (rows, T, D)``."""
        return self(tokens)

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
class HiddenState(History):
    """Hidden state of a GRU; zero is an empty history."""

    value: Tensor  # (rows, layers, width)


class GRU(nn.Module):
    """Gated recurrent unit between two linear layers."""

    def __init__(self, config: GRUConfig, num_inputs: int, num_outputs: int) -> None:
        super().__init__()
        expect_count(1, **asdict(config))
        self.config = config
        self.embed = FullLinear(num_inputs, config.width)
        self.gru = nn.GRU(config.width, config.width, config.layers, batch_first=True)
        self.head = FullLinear(config.width, num_outputs)

    def _embedded(self, tokens: Tensor) -> Tensor:
        return self.embed(tokens).to(next(self.gru.parameters()).dtype)

    def forward(self, tokens: Tensor) -> Tensor:
        """Sequences that start with an empty history: ``(rows, T, F) -> (rows, T, D)``."""
        return self.head(self.gru(self._embedded(tokens))[0])

    def read(self, tokens: Tensor, memory: HiddenState) -> Tensor:
        """``(rows, T, F) -> (rows, T, D)``; advances ``memory`` by T steps."""
        hidden = memory.value.transpose(0, 1).contiguous()
        output, value = self.gru(self._embedded(tokens), hidden)
        memory.value = stored(memory.value, value.transpose(0, 1))
        return self.head(output)

    def empty_memory(self, rows: int) -> HiddenState:
        """A hidden state of zeros for ``rows`` rows."""
        shape = (rows, self.config.layers, self.config.width)
        return HiddenState(next(self.gru.parameters()).new_zeros(shape))

    def step(self, token: Tensor, memory: HiddenState) -> Tensor:
        """``(rows, F) -> (rows, D)``; advances ``memory``."""
        return self.read(token[:, None], memory)[:, 0]


NetworkConfig = TransformerConfig | MLPConfig | GRUConfig

TRANSFORMERS = {
    "transformer-2x64": TransformerConfig(2, 64, 4),
    "transformer-2x96": TransformerConfig(2, 96, 4),
    "adaptive-4x64": TransformerConfig(4, 64, 4, band=64, pairs=True),
    "transformer-4x128": TransformerConfig(4, 128, 4),
    "transformer-4x128-products": TransformerConfig(4, 128, 4, products=True),
    "paper": TransformerConfig(6, 192, 12),
    "paper-large": TransformerConfig(6, 384, 12),
}
MLPS = (1, 16), (1, 32), (2, 32), (2, 64), (4, 64), (4, 120), (4, 128), (4, 160)
NETWORKS: dict[str, NetworkConfig] = {
    **TRANSFORMERS,
    **{f"mlp-{depth}x{width}": MLPConfig(depth, width) for depth, width in MLPS},
    "mlp-4x64-products": MLPConfig(4, 64, products=True),
    "mlp-4x128-products": MLPConfig(4, 128, products=True),
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
