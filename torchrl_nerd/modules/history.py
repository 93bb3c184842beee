"""Histories of networks, and the paper's: the last tokens, recomputed at every step."""

from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor, nn


def stored(old: Tensor, new: Tensor) -> Tensor:
    """``new``, in the memory of ``old`` unless gradients are recorded.

    A history that stays where it is can be part of a CUDA graph.
    """
    return new if torch.is_grad_enabled() else old.copy_(new)


def replaced(old: Tensor, rows: Tensor, new: Tensor | float) -> Tensor:
    """``old`` with ``rows`` (bool mask ``(rows,)``) from ``new``, see `stored`."""
    mask = rows.view(-1, *[1] * (old.ndim - 1))
    return stored(old, torch.where(mask, new, old))


@dataclass
class History:
    """Tensors of a network's past, a row for each env; a new one, all zero, is empty.

    A subclass names them; a network without a history needs none.
    """

    def clear(self, rows: Tensor) -> None:
        """Empty the history of ``rows`` (bool mask ``(rows,)``), others untouched."""
        for field in fields(self):
            old = getattr(self, field.name)
            setattr(self, field.name, replaced(old, rows, 0))

    def restore(self, past: Any, rows: Tensor) -> None:
        """Take the history of ``rows`` from a `copy.copy` of this one, made before."""
        for field in fields(self):
            old, new = (getattr(x, field.name) for x in (self, past))
            setattr(self, field.name, replaced(old, rows, new))

    def tensors(self) -> list[Tensor]:
        """All that is kept of every env, ``(rows, ...)`` each."""
        return [getattr(self, field.name) for field in fields(self)]

    def chunk(self, parts: int) -> list[Any]:
        """Histories of so many equal parts of the envs, views of this one."""
        split = [x.chunk(parts) for x in self.tensors()]
        return [type(self)(*(each[i] for each in split)) for i in range(parts)]

    def join(self, parts: list[Any]) -> None:
        """Take from the parts what is no view of this one; by default nothing."""

    def __copy__(self) -> Any:
        """Apart from the original, which is written to in place."""
        return type(self)(*(x.clone() for x in self.tensors()))


@dataclass
class TokenWindow(History):
    """The last tokens of every env, left-aligned: an env's first is at index 0."""

    tokens: Tensor  # (rows, size, width)
    age: Tensor  # (rows,): tokens seen since the env's reset, at most size

    def append(self, token: Tensor) -> Tensor:
        """Add a token to every env; returns the index it got, ``(rows,)``."""
        size = self.tokens.shape[1]
        is_full = (self.age >= size)[:, None, None]
        tokens = torch.where(is_full, self.tokens.roll(-1, 1), self.tokens)
        index = self.age.clamp_max(size - 1)  # (rows,)
        slots = torch.arange(size, device=token.device) == index[:, None]
        tokens = torch.where(slots[..., None], token[:, None], tokens)
        self.tokens = stored(self.tokens, tokens)
        self.age = stored(self.age, (self.age + 1).clamp_max(size))
        return index


class WindowNetwork(nn.Module):
    """A network that recomputes its last tokens at every step, as NeRD section 3.4 does.

    It has the network's `empty_memory` and `step`.
    """

    def __init__(self, network: nn.Module, size: int, width: int) -> None:
        super().__init__()
        self.network, self.size, self.width = network, size, width

    def empty_memory(self, rows: int) -> TokenWindow:
        """A window without tokens."""
        weight = next(self.network.parameters())
        age = torch.zeros(rows, dtype=torch.long, device=weight.device)
        return TokenWindow(weight.new_zeros(rows, self.size, self.width), age)

    def step(self, token: Tensor, memory: TokenWindow) -> Tensor:
        """``(rows, F) -> (rows, D)``; advances ``memory``."""
        index = memory.append(token)  # (rows,)
        outputs = self.network(memory.tokens)
        return outputs[torch.arange(len(token), device=token.device), index]
