"""Motion of many bodies in many robots, the batch last, and the algebra of it."""

from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from torchrl_nerd.geometry.base import keep_constants
from torchrl_nerd.geometry.constants import take

Motion = tuple[Tensor, Tensor, Tensor, Tensor]
"""Of n bodies in N robots: origins ``(3, n, N)`` m, rotations ``(3, 3, n, N)``, angular
velocities rad/s and velocities of the origins m/s, both ``(3, n, N)``, in B_t and relative
to it. N is 1 where all robots are alike; velocities may be of the first robots alone. The
batch comes last: products of many small matrices are few operations on long rows."""


def rotate_by(rotation: Tensor, vector: Tensor) -> Tensor:
    """``rotation (3, 3, n, N)`` applied to ``vector (3, n, N)``."""
    x, y, z = vector.unbind(0)
    product = torch.addcmul(rotation[:, 0] * x, rotation[:, 1], y)
    return torch.addcmul(product, rotation[:, 2], z)


def matmul(a: Tensor, b: Tensor) -> Tensor:
    """Products of matrices ``(3, 3, n, N)``."""
    product = torch.addcmul(a[:, :1] * b[0], a[:, 1:2], b[1])
    return torch.addcmul(product, a[:, 2:], b[2])


def cross(a: Tensor, b: Tensor) -> Tensor:
    """Cross products of vectors ``(3, n, N)``: twice as fast as torch's own here."""
    if not (a.shape[-1] and b.shape[-1]):  # of no robots, as where only positions count
        return a * b
    pairs = (1, 2), (2, 0), (0, 1)
    return torch.stack([a[i] * b[j] - a[j] * b[i] for i, j in pairs])


def pick(motion: Motion, places: list[int]) -> Motion:
    """The motions of the bodies at these places, in this order."""
    if places == list(range(motion[0].shape[-2])):
        return motion
    return tuple(take(x, places, -2) for x in motion)  # pyright: ignore


def join(motions: list[Motion]) -> Motion:
    """The motions of all bodies side by side."""
    if len(motions) == 1:
        return motions[0]
    return tuple(_side_by_side(same) for same in zip(*motions, strict=True))  # pyright: ignore


def _side_by_side(parts: tuple[Tensor, ...]) -> Tensor:
    counts = [part.shape[-1] for part in parts]
    rows = min(counts) and max(counts)  # a batch may be empty
    return torch.cat([part.expand(*part.shape[:-1], rows) for part in parts], -2)


def keep(module: nn.Module, **per_body: Any) -> None:
    """Keep numbers of n bodies ``(n, *size)`` as buffers ``(*size, n, 1)``."""
    for name, value in per_body.items():
        keep_constants(module, **{name: np.moveaxis(np.array(value), 0, -1)[..., None]})
