"""Causal transformer whose attention is a band, so that one step costs one token.

NeRD section 3.4 recomputes its last ten tokens at every step, with absolute positions.
Here each layer sees a token and the ``band - 1`` before it, and positions are relative (a
learned bias per head and offset). A token is written in its own base frame and never
changes as time moves on, so its keys and values are kept in a ring. The output depends on
``layers * (band - 1) + 1`` tokens. `WindowNetwork` is the paper's way.

With ``pairs`` a token is embedded together with the one before it, which adds one token to
those. What a torque did shows in the next token alone, so a pair is the least that tells
something of hidden parameters; without it a layer is spent on finding neighbours.
"""

from dataclasses import asdict, dataclass
from typing import cast

import torch
from torch import Tensor, nn

from torchrl_nerd.modules.history import stored
from torchrl_nerd.modules.kv_cache import KeyValueCache
from torchrl_nerd.modules.products import make_products
from torchrl_nerd.modules.symmetric import (
    hidden_shape,
    make_activation,
    make_embedding,
    make_head,
    make_inner,
)

MASKED = float("-inf")
LEAST = {"band": 2, "pairs": 0, "products": 0, "asymmetry": 0}  # of sizes, others 1
# Widest band whose step is made of sums of products: a product of matrices of one row is
# slower there, GPUs included. With a band of 64 it saves a third of an env's step.
NARROW = 16


@dataclass(frozen=True)
class TransformerConfig:
    """Size of a transformer."""

    layers: int = 2
    width: int = 64
    heads: int = 4  # divides width
    band: int = 10  # tokens each layer sees, the current one included (paper: h = 10)
    pairs: bool = False  # embed a token together with the one before it
    products: bool = False  # of features, see `products`
    symmetries: int = 1  # mirrors of the robot and their products; see `symmetric`
    asymmetry: bool = False  # has them but nearly; see `Embedding`

    def build(self, num_inputs: int, num_outputs: int) -> "CausalTransformer":
        """A freshly initialised network."""
        return CausalTransformer(self, num_inputs, num_outputs)


def softmax(scores: Tensor) -> Tensor:
    """Over the last dimension; of few numbers torch's own takes four times as long."""
    if scores.shape[-1] > NARROW or not scores.is_cpu:
        return scores.softmax(-1)
    parts = (scores - scores.amax(-1, keepdim=True)).exp()
    return parts / parts.sum(-1, keepdim=True)


class Attention(nn.Module):
    """Multi-head attention within a band, with a learned bias per head and offset."""

    def __init__(self, config: TransformerConfig) -> None:
        super().__init__()
        self.heads, self.band = config.heads, config.band
        self.scale = (config.width // config.heads) ** -0.5
        self.project = make_inner(config.width, 3 * config.width, config.symmetries)
        self.output = make_inner(config.width, config.width, config.symmetries)
        self.offset_bias = nn.Parameter(torch.zeros(config.heads, config.band))

    def _split(self, x: Tensor, *batch: int) -> tuple[Tensor, ...]:
        # query, key and value, (*batch, heads, head width) each
        parts = self.project(x).unflatten(-1, (3, -1)).unbind(-2)
        return tuple(part.reshape(*batch, self.heads, -1) for part in parts)

    def forward(
        self, x: Tensor, cache: KeyValueCache | None = None, layer: int = 0
    ) -> Tensor:
        """All tokens at once, ``(rows, T, *hidden)``; an empty ``cache`` is filled."""
        # (rows, heads, T, head width) each
        parts = self._split(x, *x.shape[:2])
        query, key, value = (part.transpose(1, 2) for part in parts)
        if cache is not None:
            cache.fill(layer, key, value)
        steps = torch.arange(x.shape[1], device=x.device)
        offset = steps[:, None] - steps[None, :]  # (T, T): how long ago
        is_seen = (offset >= 0) & (offset < self.band)
        bias = self.offset_bias[:, offset.clamp(0, self.band - 1)]  # (heads, T, T)
        scores = query @ key.mT * self.scale + bias
        weights = scores.masked_fill(~is_seen, MASKED).softmax(-1)
        return self.output((weights @ value).transpose(1, 2).reshape(x.shape))

    def step(self, x: Tensor, cache: KeyValueCache, layer: int) -> Tensor:
        """One token per env, ``(rows, *hidden)``, against itself and the cached ones."""
        query, key, value = self._split(x, len(x))
        # written before it is read: compiled code then copies no ring
        offset = cache.write(layer, key, value)
        is_seen = offset <= cache.age[:, None]  # (rows, band)
        keys, values = cache.keys[layer], cache.values[layer]
        is_narrow = self.band <= NARROW
        if is_narrow:
            scores = (query[:, :, None] * keys).sum(-1)  # (rows, heads, band)
        else:
            # four times as fast as keys @ query on CPUs
            scores = (query[:, :, None] @ keys.mT)[:, :, 0]
        scores = scores * self.scale + self.offset_bias[:, offset]
        weights = softmax(torch.where(is_seen[:, None], scores, MASKED))
        if is_narrow:
            mixed = (weights[..., None] * values).sum(-2)
        else:
            mixed = (weights[:, :, None] @ values)[:, :, 0]
        return self.output(mixed.reshape(x.shape))  # from (rows, heads, head width)


class FeedForward(nn.Module):
    """GELU MLP of four times the width, added to its input.

    Without a layer norm: the state is a magnitude, and dividing by a token's own size
    takes it away (a third to a half of the rollout error, see experiments/first_edition).
    """

    def __init__(self, width: int, symmetries: int = 1) -> None:
        super().__init__()
        self.expand = make_inner(width, 4 * width, symmetries)
        self.activation = make_activation(nn.GELU(), symmetries)
        self.contract = make_inner(4 * width, width, symmetries)

    def forward(self, x: Tensor) -> Tensor:
        """``(*batch, *hidden)``."""
        return x + self.contract(self.activation(self.expand(x)))


class Block(FeedForward):
    """Attention, added to its input, before the MLP."""

    def __init__(self, config: TransformerConfig) -> None:
        super().__init__(config.width, config.symmetries)
        self.attention = Attention(config)

    def forward(
        self, x: Tensor, cache: KeyValueCache | None = None, layer: int = 0
    ) -> Tensor:
        """``(rows, T, *hidden)``."""
        return super().forward(x + self.attention(x, cache, layer))

    def step(self, x: Tensor, cache: KeyValueCache, layer: int) -> Tensor:
        """``(rows, *hidden)``."""
        return super().forward(x + self.attention.step(x, cache, layer))


def initialize(blocks: nn.ModuleList) -> None:
    """Keep sizes through every layer; residual branches share the variance."""
    for name, weight in blocks.named_parameters():
        if weight.ndim >= 2 and "offset_bias" not in name:
            is_residual = name.endswith(("output.weight", "contract.weight"))
            depth = (2 * len(blocks)) ** -0.5 if is_residual else 1.0
            nn.init.normal_(weight, std=depth * weight.shape[-1] ** -0.5)


class CausalTransformer(nn.Module):
    """Tokens of features to one prediction per token.

    Raises:
        ValueError: a size that no transformer has.
    """

    def __init__(
        self, config: TransformerConfig, num_inputs: int, num_outputs: int
    ) -> None:
        super().__init__()
        for name, size in asdict(config).items():
            if size < LEAST.get(name, 1):
                raise ValueError(f"expected more {name} in a transformer, got {size}")
        if config.width % config.heads:
            raise ValueError(
                f"expected heads to divide width {config.width}, got {config.heads}"
            )
        self.config = config
        sizes = config.width, config.symmetries
        self.embed = make_embedding(num_inputs, *sizes, asymmetry=config.asymmetry)
        self.embed_last = None
        if config.pairs:
            self.embed_last = make_embedding(num_inputs, *sizes, bias=False)
        self.blocks = nn.ModuleList(Block(config) for _ in range(config.layers))
        self.head = make_head(config.width, num_outputs, config.symmetries)
        self.products = make_products(config.products, num_inputs, num_outputs, *sizes)
        initialize(self.blocks)

    def forward(self, tokens: Tensor) -> Tensor:
        """Sequences that start with an empty history: ``(rows, T, F) -> (rows, T, D)``."""
        return self.read(tokens, None)

    def read(self, tokens: Tensor, memory: KeyValueCache | None) -> Tensor:
        """As `forward`; ``memory`` is then as after so many steps from an empty one.

        It has to be empty: what it holds is replaced.
        """
        x, factors = self.products.enter(self.embed(tokens), tokens)
        if self.embed_last is not None:
            adds = self.embed_last(tokens)  # (rows, T, *hidden), to the next one
            x = torch.cat((x[:, :1], x[:, 1:] + adds[:, :-1]), 1)
            if memory is not None:
                memory.last = stored(memory.last, adds[:, -1])
        for layer, block in enumerate(self.blocks):
            x = block(x, memory, layer)
        if memory is not None:
            memory.begin(tokens.shape[1])
        return self.products.leave(self.head(x), x, factors)

    def empty_memory(self, rows: int) -> KeyValueCache:
        """A history of nothing for ``rows`` rows."""
        c, weight = self.config, self.embed.weight
        shape = (rows, c.heads, c.band, c.width // c.heads)
        keys = [weight.new_zeros(shape) for _ in range(c.layers)]
        values = [torch.zeros_like(key) for key in keys]
        age = torch.zeros(rows, dtype=torch.long, device=weight.device)
        hidden = hidden_shape(c.width, c.symmetries) if c.pairs else (0,)
        last = weight.new_zeros(rows, *hidden)
        return KeyValueCache(keys, values, age, age.new_zeros(1), last)

    def step(self, token: Tensor, memory: KeyValueCache) -> Tensor:
        """Next token of all envs, ``(rows, F) -> (rows, D)``; advances ``memory``."""
        x, factors = self.products.enter(self.embed(token), token)
        if self.embed_last is not None:
            x = x + memory.last
            memory.last = stored(memory.last, self.embed_last(token))
        for layer, block in enumerate(self.blocks):
            x = cast(Block, block).step(x, memory, layer)
        memory.advance()
        return self.products.leave(self.head(x), x, factors)
