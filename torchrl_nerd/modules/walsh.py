"""The Walsh-Hadamard transform: parts of a vector to characters of (Z_2)^n, and back."""

from collections.abc import Sequence

import torch
from torch import Tensor


def walsh_signs(order: int) -> Tensor:
    """Walsh matrix ``(order, order)`` of signs: minus where i & k has odd parity."""
    signs = [[(-1) ** (i & k).bit_count() for k in range(order)] for i in range(order)]
    return torch.tensor(signs, dtype=torch.int8)  # stays so where weights are cast


def walsh_matrix(signs: Tensor, dtype: torch.dtype) -> Tensor:
    """The orthogonal matrix ``(K, K)`` of such signs, its own inverse."""
    return signs.to(dtype) * len(signs) ** -0.5


def walsh_sums(parts: Sequence[Tensor]) -> list[Tensor]:
    """The K sums of K parts with the signs of `walsh_signs`, in K log2(K) additions."""
    sums, stride = list(parts), 1
    while stride < len(sums):
        for low in range(len(sums)):
            if not low & stride:
                a, b = sums[low], sums[low | stride]
                sums[low], sums[low | stride] = a + b, a - b
        stride *= 2
    return sums


def transform(x: Tensor, signs: Tensor) -> Tensor:
    """Parts to characters and back, ``(*batch, K, n)``."""
    first = x.movedim(-2, 0)  # (K, *batch, n), which is how blocks leave it in memory
    mixed = walsh_matrix(signs, x.dtype) @ first.flatten(1)
    return mixed.view(first.shape).movedim(0, -2)
