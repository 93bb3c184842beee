"""Networks of symmetric robots, averaged over symmetric copies of what they are given.

An ant turned by 90 degrees is the same ant with its legs renumbered, but another input to
a network. The mean over a group of K symmetries,

    f(x) = 1/K sum_k  P_k^-1 network(T_k x),

has them itself: f(T_k x) = P_k f(x). T_k and P_k are signed permutations of the entries of
token and output. Errors that differ from copy to copy cancel in part. Such a mean is the
Reynolds operator of the group; see Puny et al., https://arxiv.org/abs/2110.03336.
"""

import copy
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from torchrl_nerd.modules.history import History


@dataclass
class CopiesHistory(History):
    """The history of a network that sees ``count`` copies of every env."""

    past: Any  # of (rows * count) rows: the copies of a row follow one another
    count: int

    def clear(self, rows: Tensor) -> None:
        """See `History.clear`."""
        self.past.clear(rows.repeat_interleave(self.count))

    def restore(self, past: "CopiesHistory", rows: Tensor) -> None:
        """See `History.restore`."""
        self.past.restore(past.past, rows.repeat_interleave(self.count))

    def __copy__(self) -> "CopiesHistory":
        """See `History.__copy__`."""
        return CopiesHistory(copy.copy(self.past), self.count)


class EquivariantNetwork(nn.Module):
    """The mean of a network over symmetric copies, with the signature of the network.

    All copies are the input itself until `set_copies`, or a checkpoint, says otherwise.

    Args:
        network: any with the signature of `Network`.
        copies: K.
        num_inputs: F.
        num_outputs: D.
    """

    network: Any  # a module that is a `Network`
    token_sources: Tensor
    token_signs: Tensor
    output_sources: Tensor
    output_signs: Tensor

    def __init__(
        self, network: nn.Module, copies: int, num_inputs: int, num_outputs: int
    ) -> None:
        super().__init__()
        self.network, self.copies = network, copies
        for name, size in (("token", num_inputs), ("output", num_outputs)):
            same = torch.arange(size).repeat(copies, 1)  # (K, size)
            self.register_buffer(f"{name}_sources", same)
            self.register_buffer(f"{name}_signs", torch.ones(copies, size))
        self.register_load_state_dict_post_hook(_expect_entries)

    def set_copies(
        self, tokens: tuple[Tensor, Tensor], outputs: tuple[Tensor, Tensor]
    ) -> None:
        """Take the group: sources and signs ``(K, F)`` of tokens, ``(K, D)`` of outputs.

        Entry j of a copy is ``signs[j] x[sources[j]]``.
        """
        back = outputs[0].argsort(-1)  # (K, D): P_k^-1
        inverse = back, outputs[1].gather(-1, back)
        for name, (sources, signs) in (("token", tokens), ("output", inverse)):
            self.get_buffer(f"{name}_sources").copy_(sources)
            self.get_buffer(f"{name}_signs").copy_(signs)

    @property
    def head(self) -> nn.Module:
        """The network's last layer."""
        return self.network.head

    def forward(self, tokens: Tensor) -> Tensor:
        """``(rows, T, F) -> (rows, T, D)``."""
        return self._mean(self.network(self._copied(tokens)))

    def empty_memory(self, rows: int) -> CopiesHistory:
        """An empty history of every copy of ``rows`` envs."""
        past = self.network.empty_memory(rows * self.copies)
        return CopiesHistory(past, self.copies)

    def step(self, token: Tensor, memory: CopiesHistory) -> Tensor:
        """``(rows, F) -> (rows, D)``; advances ``memory``."""
        return self._mean(self.network.step(self._copied(token), memory.past))

    def _copied(self, tokens: Tensor) -> Tensor:
        """``(rows, ..., F) -> (rows * K, ..., F)``."""
        copies = tokens[..., self.token_sources] * self.token_signs.to(tokens.dtype)
        return copies.movedim(-2, 1).flatten(0, 1)  # from (rows, ..., K, F)

    def _mean(self, outputs: Tensor) -> Tensor:
        """``(rows * K, ..., D) -> (rows, ..., D)``."""
        apart = outputs.unflatten(0, (-1, self.copies)).movedim(1, -2)
        index = self.output_sources.expand(apart.shape)  # (rows, ..., K, D)
        return (apart.gather(-1, index) * self.output_signs.to(outputs.dtype)).mean(-2)


def _expect_entries(network: EquivariantNetwork, _: Any) -> None:
    """Refuse sources, loaded from a file, that are no entries.

    Raises:
        ValueError: there are some.
    """
    for sources in (network.token_sources, network.output_sources):
        size = sources.shape[1]
        if bool(((sources < 0) | (sources >= size)).any()):
            low, high = int(sources.min()), int(sources.max())
            raise ValueError(
                f"expected symmetric copies made of entries 0 to {size - 1}, got "
                f"entries {low} to {high}"
            )
