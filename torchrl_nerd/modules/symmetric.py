"""Layers of a network that has the mirror symmetries of its robot.

A mirrored ant is the same ant with its legs renumbered, but another input to a network.
Let T_k and P_k be what K = 2^n commuting mirrors make of token and output, signed
permutations that undo themselves. A network f built of these layers has the symmetries
itself, whatever its weights:

    f(T_k x) = P_k f(x)

Inside, every mirror permutes K parts of the hidden vector. The Walsh-Hadamard transform of
the parts turns that into changes of sign, one part per character of the group (Z_2)^n. A
linear layer that commutes with them keeps the characters apart: its matrix has K blocks on
the diagonal, and so a K-th of the products. Activation functions act on the parts. See
Ordonez-Apraez et al., https://arxiv.org/abs/2402.15552, on symmetries of robots.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from torchrl_nerd.modules.linear import FullLinear, InnerLinear
from torchrl_nerd.modules.walsh import transform, walsh_matrix, walsh_signs, walsh_sums

HEAD_WIDTH = 64  # paper, appendix A

SignedCopies = tuple[Tensor, Tensor]
"""Sources and signs ``(K, size)``: copy k has entries ``signs[k, j] x[sources[k, j]]``."""


def expect_symmetries(width: int, symmetries: int) -> None:
    """Refuse a number of symmetries that no layer of this width has.

    Raises:
        ValueError: not a power of two, or one that does not divide the widths of the
            network and its head.
    """
    is_power = symmetries > 0 and symmetries.bit_count() == 1
    if not is_power or width % symmetries or HEAD_WIDTH % symmetries:
        raise ValueError(
            f"expected symmetries to be a power of two that divides width {width} and the "
            f"head's {HEAD_WIDTH}, got {symmetries}"
        )


def block_product(x: Tensor, weight: Tensor) -> Tensor:
    """Every character by its own matrix: ``(*batch, K, in)``, ``(K, out, in)``."""
    flat = x.reshape(-1, *x.shape[-2:]).transpose(0, 1)  # (K, batch, in)
    return torch.bmm(flat, weight.mT).transpose(0, 1).unflatten(0, x.shape[:-2])


class Activation(nn.Module):
    """A function of the parts in characters: an activation, or a product of two."""

    signs: Tensor

    def __init__(self, function: Callable[..., Tensor], symmetries: int) -> None:
        super().__init__()
        self.function = function
        self.register_buffer("signs", walsh_signs(symmetries), persistent=False)

    def forward(self, *inputs: Tensor) -> Tensor:
        """``(*batch, K, n)``: `transform`, the function, and `transform` once more."""
        firsts = [x.movedim(-2, 0) for x in inputs]  # (K, *batch, n)
        scale = len(self.signs) ** -0.5
        if torch.compiler.is_compiling():  # one loop for all three
            parts = [
                walsh_sums([x * scale for x in first.unbind()]) for first in firsts
            ]
            after = walsh_sums([self.function(*x) for x in zip(*parts, strict=True)])
            return torch.stack([x * scale for x in after], -2)
        mixing = walsh_matrix(self.signs, inputs[0].dtype)
        # (K, batch * n): fast for the function
        after = mixing @ self.function(*(mixing @ first.flatten(1) for first in firsts))
        return after.view(firsts[0].shape).movedim(0, -2)


class BlockLinear(InnerLinear):
    """An inner linear layer ``(*batch, K, in / K) -> (*batch, K, out / K)``."""

    def __init__(self, num_inputs: int, num_outputs: int, symmetries: int) -> None:
        super().__init__(num_inputs // symmetries, num_outputs // symmetries, False)
        self.weight = _blocks(self.weight, symmetries)

    def multiply(self, x: Tensor) -> Tensor:
        """See `block_product`."""
        return block_product(x, self.weight)


class Parts(FullLinear):
    """From characters to parts: ``(*batch, K, in / K) -> (*batch, K, out / K)``."""

    signs: Tensor

    def __init__(self, num_inputs: int, num_outputs: int, symmetries: int) -> None:
        super().__init__(num_inputs // symmetries, num_outputs // symmetries)
        self.weight = _blocks(self.weight, symmetries)
        self.register_buffer("signs", walsh_signs(symmetries), persistent=False)

    def multiply(self, x: Tensor) -> Tensor:
        """Blocks, the transform, and one bias for all parts."""
        return transform(block_product(x, self.weight), self.signs) + self.bias


class Mirrored(FullLinear):
    """An end of the network, whose entries the mirrors permute."""

    sources: Tensor
    entry_signs: Tensor

    def __init__(
        self, shape: tuple[int, int], size: int, symmetries: int, bias: bool = True
    ) -> None:
        super().__init__(*shape, bias)
        same = torch.arange(size).repeat(symmetries, 1)  # (K, size)
        self.register_buffer("sources", same)
        self.register_buffer("entry_signs", torch.ones(symmetries, size))
        self.register_load_state_dict_post_hook(_expect_entries)

    def set_mirrors(self, mirrors: SignedCopies) -> None:
        """Take what the mirrors make of the entries."""
        self.sources.copy_(mirrors[0])
        self.entry_signs.copy_(mirrors[1])

    def mirrored(self, weight: Tensor) -> Tensor:
        """``weight (n, size)`` times T_k for every k, ``(n, K, size)``."""
        taken = weight.index_select(1, self.sources.flatten())
        return taken.unflatten(1, self.sources.shape) * self.entry_signs


class Embedding(Mirrored):
    """Characters of a token: part k is ``W T_k x + b``, and ``b_k`` with an asymmetry.

    Of a robot that has its mirrors but nearly, the biases of the other characters say how
    it differs from its mirrored self. They are zero at first.
    """

    signs: Tensor

    def __init__(
        self,
        num_inputs: int,
        width: int,
        symmetries: int,
        bias: bool = True,
        asymmetry: bool = False,
    ) -> None:
        shape = num_inputs, width // symmetries
        super().__init__(shape, num_inputs, symmetries, bias)
        odd = torch.zeros(width - shape[1]) if asymmetry else None
        self.asymmetry = None if odd is None else nn.Parameter(odd)
        self.register_buffer("signs", walsh_signs(symmetries), persistent=False)

    def multiply(self, x: Tensor) -> Tensor:
        """``(*batch, F) -> (*batch, K, width / K)``."""
        weight = transform(self.mirrored(self.weight), self.signs)  # (width / K, K, F)
        symmetries, size = len(self.signs), len(self.weight)
        bias = self.bias
        if bias is not None:  # the same in all parts: in the first character alone
            bias = F.pad(bias * symmetries**0.5, (0, (symmetries - 1) * size))
            if self.asymmetry is not None:
                bias = bias + F.pad(self.asymmetry, (size, 0))
        flat = F.linear(x, weight.transpose(0, 1).flatten(0, 1), bias)
        return flat.unflatten(-1, (symmetries, size))


class Readout(Mirrored):
    """Predictions from parts: ``sum_k P_k V h_k``, and the bias that mirrors leave."""

    def __init__(self, width: int, num_outputs: int, symmetries: int) -> None:
        shape = width // symmetries, num_outputs
        super().__init__(shape, num_outputs, symmetries)
        with torch.no_grad():
            self.weight.mul_(symmetries**-0.5)  # a sum of so many

    def multiply(self, x: Tensor) -> Tensor:
        """``(*batch, K, width / K) -> (*batch, D)``."""
        weight = self.mirrored(self.weight.mT)  # (width / K, K, D)
        bias = self.mirrored(self.bias[None]).mean((0, 1))  # (D,)
        return F.linear(x.flatten(-2), weight.transpose(0, 1).flatten(0, 1).mT, bias)


class DirectReadout(Readout):
    """Predictions from characters."""

    signs: Tensor

    def __init__(self, width: int, num_outputs: int, symmetries: int) -> None:
        super().__init__(width, num_outputs, symmetries)
        self.register_buffer("signs", walsh_signs(symmetries), persistent=False)

    def multiply(self, x: Tensor) -> Tensor:
        """``(*batch, K, width / K) -> (*batch, D)``."""
        return super().multiply(transform(x, self.signs))


def set_mirrors(
    network: nn.Module, tokens: SignedCopies, outputs: SignedCopies
) -> None:
    """Tell a network what the mirrors of its robot make of tokens and outputs."""
    for layer in network.modules():
        if isinstance(layer, Mirrored):
            layer.set_mirrors(outputs if isinstance(layer, Readout) else tokens)


def hidden_shape(width: int, symmetries: int) -> tuple[int, ...]:
    """``*hidden``: ``(width,)``, or ``(K, width / K)`` in a symmetric network."""
    return (width,) if symmetries == 1 else (symmetries, width // symmetries)


def make_embedding(
    num_inputs: int,
    width: int,
    symmetries: int,
    bias: bool = True,
    asymmetry: bool = False,
) -> FullLinear:
    """From a token to the hidden vector."""
    if symmetries == 1:
        return FullLinear(num_inputs, width, bias)
    expect_symmetries(width, symmetries)
    return Embedding(num_inputs, width, symmetries, bias, asymmetry)


def make_inner(num_inputs: int, num_outputs: int, symmetries: int) -> InnerLinear:
    """A linear layer of the hidden vector, without bias."""
    if symmetries == 1:
        return InnerLinear(num_inputs, num_outputs, bias=False)
    return BlockLinear(num_inputs, num_outputs, symmetries)


def make_activation(function: nn.Module, symmetries: int) -> nn.Module:
    """An activation function of the hidden vector."""
    return function if symmetries == 1 else Activation(function, symmetries)


def make_product(symmetries: int) -> Callable[[Tensor, Tensor], Tensor]:
    """The product of two hidden vectors, entry by entry."""
    return torch.mul if symmetries == 1 else Activation(torch.mul, symmetries)


def make_readout(width: int, num_outputs: int, symmetries: int) -> FullLinear:
    """From the hidden vector to predictions, without a layer between."""
    if symmetries == 1:
        return FullLinear(width, num_outputs)
    return DirectReadout(width, num_outputs, symmetries)


def make_head(width: int, num_outputs: int, symmetries: int) -> nn.Sequential:
    """From a block's width to predictions; SiLU for the paper's ReLU: half the error."""
    if symmetries == 1:
        first, last = FullLinear(width, HEAD_WIDTH), FullLinear(HEAD_WIDTH, num_outputs)
    else:
        first = Parts(width, HEAD_WIDTH, symmetries)
        last = Readout(HEAD_WIDTH, num_outputs, symmetries)
    return nn.Sequential(first, nn.SiLU(), last)


def _blocks(weight: Tensor, count: int) -> nn.Parameter:
    """So many matrices of that shape, drawn as a linear layer's weight is."""
    bound = weight.shape[1] ** -0.5
    blocks = weight.detach().new_empty(count, *weight.shape)
    return nn.Parameter(blocks.uniform_(-bound, bound))


def _expect_entries(layer: Mirrored, _: Any) -> None:
    """Refuse mirrors, loaded from a file, that are no signed permutations.

    Raises:
        ValueError: some entry is missing or twice, or a sign neither 1 nor -1.
    """
    count, size = layer.sources.shape
    every = torch.arange(size, device=layer.sources.device)
    is_whole = (layer.sources.sort(1).values == every).all(1)  # (K,)
    for number, whole in enumerate(is_whole.tolist()):
        if not whole:
            raise ValueError(
                f"expected mirror {number} of {count} to have every entry from 0 to "
                f"{size - 1} once, got {layer.sources[number].tolist()}"
            )
    signs = layer.entry_signs
    if not (signs.abs() == 1.0).all():
        odd = float(signs[signs.abs() != 1.0][0])
        raise ValueError(f"expected signs 1 or -1 of mirrored entries, got {odd}")
