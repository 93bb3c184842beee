"""Random numbers that belong to an env, not to a batch.

Each number is a hash of (seed, env, episode, index), on every device, whatever the number
of envs and whichever are reset beside it. The hash is SplitMix64 (Steele, Lea and Flood,
OOPSLA 2014, https://doi.org/10.1145/2660193.2660195). Ranges of envs and numbers are made
outside of compiled code, where their products are not kept modulo 2^64 (torch 2.13, CPU).
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


def env_keys(seed: int, num_envs: int, device: torch.device | str = "cpu") -> Tensor:
    """What sets the streams of envs apart, int64 ``(num_envs,)``."""
    env = torch.arange(num_envs, device=device)
    key = _mix(torch.full_like(env, seed) * GOLDEN)
    return _mix(key + (env + 1) * GOLDEN)


def stream_offsets(count: int, device: torch.device | str = "cpu") -> Tensor:
    """What sets the numbers of an episode apart, int64 ``(count,)``."""
    return torch.arange(1, count + 1, device=device) * GOLDEN


def uniforms(
    keys: Tensor, episode: Tensor, offsets: Tensor, dtype: torch.dtype = torch.float64
) -> Tensor:
    """Uniform numbers in [0, 1), ``(num_envs, count)``.

    They have as many bits as their type holds. They follow from the keys of `env_keys`,
    how many episodes each env has begun, int64 ``(num_envs,)``, and the offsets of
    `stream_offsets`.
    """
    keys = _mix(keys + (episode + 1) * GOLDEN)
    bits = _mix(keys[:, None] + offsets)  # (num_envs, count)
    held = 53 if dtype == torch.float64 else 24  # bits of a float's fraction
    return _shift_right(bits, 64 - held).to(dtype) * 2.0**-held
