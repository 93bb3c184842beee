"""Random numbers that belong to a row, not to a batch.

Row i of episode k gets the same numbers whatever the number of rows, whichever rows are
reset beside it, and on every device: each number is a hash of (seed, row, episode, index).
The hash is SplitMix64 (Steele, Lea and Flood, "Fast splittable pseudorandom number
generators", OOPSLA 2014, https://doi.org/10.1145/2660193.2660195). It stays out of compiled
code, where integers that overflow are not kept modulo 2^64 (torch 2.13 on a CPU).
"""

import torch
from torch import Tensor

GOLDEN = -7046029254386353131  # 0x9E3779B97F4A7C15 as a signed number
MIX_1 = -4658895280553007687  # 0xBF58476D1CE4E5B9
MIX_2 = -7723592293110705685  # 0x94D049BB133111EB


def _shift_right(x: Tensor, bits: int) -> Tensor:
    """Logical shift of a signed 64-bit number."""
    return (x >> bits) & ((1 << (64 - bits)) - 1)


def _mix(x: Tensor) -> Tensor:
    x = (x ^ _shift_right(x, 30)) * MIX_1
    x = (x ^ _shift_right(x, 27)) * MIX_2
    return x ^ _shift_right(x, 31)


def row_uniforms(seed: int, episode: Tensor, count: int) -> Tensor:
    """Uniform numbers in [0, 1), ``(rows, count)``, float64.

    Args:
        seed: of the env.
        episode: ``(rows,)`` int64: how many episodes each row has begun.
        count: numbers per row.
    """
    device = episode.device
    row = torch.arange(len(episode), device=device)
    key = _mix(torch.full_like(row, seed) * GOLDEN)
    for part in (row, episode):
        key = _mix(key + (part + 1) * GOLDEN)
    index = torch.arange(1, count + 1, device=device)
    bits = _mix(key[:, None] + index * GOLDEN)
    return _shift_right(bits, 11).to(torch.float64) * 2.0**-53
