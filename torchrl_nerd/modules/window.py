"""The paper's inference: the last h tokens recomputed at every step."""

import torch
from torch import Tensor, nn


class TokenWindow:
    """The last ``size`` tokens of every row, left-aligned: a row's first is at index 0."""

    def __init__(self, rows: int, size: int, width: int, like: Tensor) -> None:
        self.tokens = like.new_zeros(rows, size, width)
        self.age = torch.zeros(rows, dtype=torch.long, device=like.device)

    def clear(self, rows: Tensor) -> None:
        """Empty the history of ``rows`` (bool mask ``(num_rows,)``), others untouched."""
        self.tokens = torch.where(rows[:, None, None], 0.0, self.tokens)
        self.age = self.age.masked_fill(rows, 0)

    def append(self, token: Tensor) -> Tensor:
        """Add a token to every row; returns the index it got, ``(rows,)``."""
        size = self.tokens.shape[1]
        is_full = self.age >= size
        shifted = self.tokens.roll(-1, 1)
        tokens = torch.where(is_full[:, None, None], shifted, self.tokens)
        index = self.age.clamp_max(size - 1)
        slots = torch.arange(size, device=token.device) == index[:, None]
        self.tokens = torch.where(slots[..., None], token[:, None], tokens)
        self.age = (self.age + 1).clamp_max(size)
        return index


class WindowNetwork(nn.Module):
    """A network run in the paper's way; the same signature as the network itself."""

    def __init__(self, network: nn.Module, size: int, width: int) -> None:
        super().__init__()
        self.network, self.size, self.width = network, size, width

    def empty_memory(self, rows: int) -> TokenWindow:
        """A window without tokens."""
        like = next(self.network.parameters())
        return TokenWindow(rows, self.size, self.width, like)

    def step(self, token: Tensor, memory: TokenWindow) -> Tensor:
        """``(rows, F) -> (rows, D)``; advances ``memory``."""
        index = memory.append(token)
        outputs = self.network(memory.tokens)
        return outputs[torch.arange(len(token), device=token.device), index]
