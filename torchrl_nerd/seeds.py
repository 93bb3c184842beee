"""Random numbers of their own for each part of a whole that has one seed."""

from torch import Generator

PARTS = 24  # bits: as many parts a seed has room for
GOLDEN = 0x9E3779B1  # 2**32 over the golden ratio, odd: spreads what does not fit


def fold_in(seed: int, number: int) -> Generator:
    """The generator of part ``number`` of what ``seed`` seeds.

    torch's generator on a processor takes no more than 32 bits of a seed, without a word:
    seeds that were set apart by higher ones would draw the same.

    Source: https://github.com/pytorch/pytorch/blob/main/aten/src/ATen/core/MT19937RNGEngine.h
    """
    high = (seed >> (32 - PARTS)) * GOLDEN
    return Generator().manual_seed((((seed << PARTS) + number) ^ high) & 0xFFFFFFFF)
