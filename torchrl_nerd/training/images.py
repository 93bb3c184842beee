"""Symmetry images of tokens and targets: entries renumbered, some with the other sign."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torchrl_nerd.transforms import Stats

SAME = 1e-7  # relative to the largest of a column
ALIKE = 1e-3  # standard deviations: more than rounding, less than a network sees


class Images:
    """What each isometry does to a kind of vector: ``image[j] = sign[j] x[source[j]]``.

    Found by looking: every entry of an image is one of the original's, up to its sign.

    Args:
        original: ``(N, F)``, samples in which every entry that ever differs from zero
            does so somewhere.
        images: the same samples under each isometry, ``(N, F)``.

    Raises:
        ValueError: an entry of an image that is none of the original's.
    """

    def __init__(self, original: Tensor, images: Sequence[Tensor]) -> None:
        pairs = [_match(original, image) for image in images]
        self.sources, self.signs = (torch.stack(x) for x in zip(*pairs, strict=True))

    def __call__(self, x: Tensor, choice: Tensor) -> Tensor:
        """Images of ``x (rows, length, F)``, each row by isometry ``choice (rows,)``."""
        sources = self.sources[choice][:, None].expand(x.shape)
        return x.gather(-1, sources) * self.signs[choice][:, None].to(x.dtype)

    def complete(self, stats: Stats) -> Stats:
        """Statistics of all images of the samples that ``stats`` is of.

        With these, normalised vectors are renumbered as raw ones are.
        """
        merged, *others = (
            Stats(stats.count, sign * stats.mean[source], stats.m2[source])
            for source, sign in zip(self.sources, self.signs, strict=True)
        )
        for other in others:
            merged = merged.merge(other)
        return merged

    def keep(self, mean: Tensor, std: Tensor) -> bool:
        """Whether images of samples of these statistics ``(F,)`` have the same ones."""
        means, stds = self.signs * mean[self.sources], std[self.sources]
        apart = torch.maximum((means - mean).abs(), (stds - std).abs())
        return bool((apart < ALIKE * std).all())

    def to(self, device: torch.device) -> "Images":
        """On another device, in place."""
        self.sources, self.signs = self.sources.to(device), self.signs.to(device)
        return self


def telling_rows(x: Tensor, per_column: int = 8) -> Tensor:
    """Indices of the samples in ``x (N, F)`` with the largest entries of each column."""
    count = min(per_column, len(x))
    return x.abs().topk(count, 0).indices.flatten().unique()


def _match(original: Tensor, image: Tensor) -> tuple[Tensor, Tensor]:
    scale = SAME * (original.abs().amax(0) + 1e-3)
    sources, signs = [], []
    for j, column in enumerate(image.T):
        for sign in (1.0, -1.0):
            apart = (column[:, None] - sign * original).abs().amax(0)
            fits = (apart <= scale).nonzero()[:, 0].tolist()
            if fits:  # of several alike, such as constants, its own
                sources.append(j if j in fits else fits[0])
                signs.append(sign)
                break
        else:
            raise ValueError(f"entry {j} of the image is no entry of the original")
    return torch.tensor(sources), torch.tensor(signs, dtype=torch.float64)
