"""A network that recomputes its last tokens at every step, as NeRD section 3.4 does."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from torchrl_nerd.modules.transformer import stored


@dataclass
class TokenWindow:
    """The last tokens of every row, left-aligned: a row's first is at index 0."""

    tokens: Tensor  # (rows, size, width)
    age: Tensor  # (rows,): tokens seen since the row's reset, at most size

    def clear(self, rows: Tensor) -> None:
        """Empty the history of ``rows`` (bool mask ``(num_rows,)``), others untouched."""
        tokens = torch.where(rows[:, None, None], 0.0, self.tokens)
        self.tokens = stored(self.tokens, tokens)
        self.age.masked_fill_(rows, 0)

    def __copy__(self) -> "TokenWindow":
        """Apart from the original, which is written to in place."""
        return TokenWindow(self.tokens.clone(), self.age.clone())

    def restore(self, past: "TokenWindow", rows: Tensor) -> None:
        """See `History.restore`."""
        tokens = torch.where(rows[:, None, None], past.tokens, self.tokens)
        self.tokens = stored(self.tokens, tokens)
        self.age.copy_(torch.where(rows, past.age, self.age))

    def append(self, token: Tensor) -> Tensor:
        """Add a token to every row; returns the index it got, ``(rows,)``."""
        size = self.tokens.shape[1]
        is_full = (self.age >= size)[:, None, None]
        tokens = torch.where(is_full, self.tokens.roll(-1, 1), self.tokens)
        index = self.age.clamp_max(size - 1)  # (rows,)
        slots = torch.arange(size, device=token.device) == index[:, None]
        tokens = torch.where(slots[..., None], token[:, None], tokens)
        self.tokens = stored(self.tokens, tokens)
        self.age.add_(1).clamp_(max=size)
        return index


class WindowNetwork(nn.Module):
    """A network run in the paper's way; the same signature as the network itself."""

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
