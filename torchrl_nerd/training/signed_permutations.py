"""Signed permutations: what a symmetry of a robot makes of a vector's entries."""

from collections.abc import Sequence
from itertools import combinations

import torch
from torch import Tensor, nn

from torchrl_nerd.geometry.base import keep_constants, keep_indices
from torchrl_nerd.modules.symmetric import SignedCopies
from torchrl_nerd.transforms import Stats

RTOL = 1e-7  # of equal entries, relative to the largest of a column
STATS_TOL = 1e-3  # standard deviations: more than rounding, less than a network notices


class SignedPermutations(nn.Module):
    """Symmetric copies of a kind of vector: ``copy[j] = sign[j] x[source[j]]``.

    ``matched`` is what `match_entries` gives for the copies by each isometry.
    """

    sources: Tensor
    signs: Tensor

    def __init__(self, matched: Sequence[tuple[list[int], list[float]]]) -> None:
        super().__init__()
        sources, signs = zip(*matched, strict=True)
        keep_indices(self, sources=sources)  # (isometries, F)
        keep_constants(self, signs=signs)

    @property
    def copies(self) -> SignedCopies:
        """Sources and signs of all of them."""
        return self.sources, self.signs

    def forward(self, x: Tensor, choice: Tensor) -> Tensor:
        """Copies of ``x (batch, length, F)``, each by isometry ``choice (batch,)``."""
        sources = self.sources[choice][:, None].expand(x.shape)  # (batch, length, F)
        return x.gather(-1, sources) * self.signs[choice][:, None].to(x.dtype)

    def complete(self, stats: Stats) -> Stats:
        """Statistics of all copies: with these, normalised vectors map as raw ones."""
        return Stats.merge_all(
            Stats(stats.count, sign * stats.mean[source], stats.m2[source])
            for source, sign in zip(self.sources, self.signs, strict=True)
        )

    def keep(self, mean: Tensor, std: Tensor) -> bool:
        """Whether copies of samples of these statistics ``(F,)`` have the same ones."""
        means, stds = self.signs * mean[self.sources], std[self.sources]
        apart = torch.maximum((means - mean).abs(), (stds - std).abs())
        return bool((apart < STATS_TOL * std).all())

    def have(self, copies: SignedCopies) -> bool:
        """Whether each of these ``(K, F)`` is one of them."""
        mine, asked = ((1 + x) * s for x, s in (self.copies, copies))  # (*, F)
        return bool((asked[:, None] == mine).all(-1).any(1).all())

    def mirrors(self, count: int) -> list[int] | None:
        """Numbers of ``count = 2^n`` isometries, products of n that commute; None if fewer.

        Each undoes itself: mirrors, and half turns. Number k is the product of the
        generators whose bits are set in k. The identity is first, and no entries are alike,
        so that each isometry is another permutation.
        """
        rows = zip(self.sources.tolist(), self.signs.tolist(), strict=True)
        known = [tuple(zip(*row, strict=True)) for row in rows]
        place = {copy: number for number, copy in enumerate(known)}

        def after(second: int, first: int) -> int | None:
            """The copy of a copy: by ``first``, then by ``second``; None: not known."""
            entries = known[first]
            twice = ((entries[j][0], sign * entries[j][1]) for j, sign in known[second])
            return place.get(tuple(twice))

        own_inverse = [k for k in range(1, len(known)) if after(k, k) == 0]
        for generators in combinations(own_inverse, count.bit_length() - 1):
            pairs = combinations(generators, 2)
            if all(after(a, b) == after(b, a) for a, b in pairs):
                members: list[int] = [0]
                for generator in generators:
                    more = [after(generator, member) for member in members]
                    members += [member for member in more if member is not None]
                if len(members) == len(set(members)) == count:
                    return members
        return None


def match_entries(
    original: Tensor, copy: Tensor
) -> tuple[list[int], list[float]] | None:
    """Sources and signs of a copy's entries, from samples ``(N, F)`` of both.

    Every entry that is ever not zero must be so in a sample. None where an entry of the
    copy is none of the original's.
    """
    scale = RTOL * (original.abs().amax(0) + 1e-3)
    sources, signs = [], []
    for j, column in enumerate(copy.T):
        for sign in (1.0, -1.0):
            apart = (column[:, None] - sign * original).abs().amax(0)
            fits = (apart <= scale).nonzero()[:, 0].tolist()
            if fits:  # of several alike, such as constants, its own
                sources.append(j if j in fits else fits[0])
                signs.append(sign)
                break
        else:
            return None
    return sources, signs
