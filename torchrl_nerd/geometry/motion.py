"""Poses and velocities of many bodies of many robots, batch last."""

import torch
from torch import Tensor

Motion = tuple[Tensor, Tensor, Tensor, Tensor]
"""Of n bodies in N rows: origins ``(3, n, N)`` m, rotations ``(3, 3, n, N)``, angular
velocities rad/s and velocities of the origins m/s, both ``(3, n, N)``, in B_t and relative
to it. N is 1 where all rows are alike; velocities may be of the first rows alone. Rows come
last, so that a product of many small matrices is a few operations on long rows."""


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
    pairs = (1, 2), (2, 0), (0, 1)
    return torch.stack([a[i] * b[j] - a[j] * b[i] for i, j in pairs])


def pick(motion: Motion, places: list[int]) -> Motion:
    """The motions at these places, in this order."""
    if places == list(range(motion[0].shape[-2])):
        return motion
    position, rotation, omega, velocity = motion
    return (
        position[:, places],
        rotation[:, :, places],
        omega[:, places],
        velocity[:, places],
    )


def join(motions: list[Motion]) -> Motion:
    """Motions side by side."""
    if len(motions) == 1:
        return motions[0]
    position, rotation, omega, velocity = (
        side_by_side(same) for same in zip(*motions, strict=True)
    )
    return position, rotation, omega, velocity


def side_by_side(parts: tuple[Tensor, ...]) -> Tensor:
    """Bodies together; where all rows of a part are alike, there as many as elsewhere."""
    counts = [part.shape[-1] for part in parts]
    rows = min(counts) and max(counts)  # a batch may be empty
    return torch.cat([part.expand(*part.shape[:-1], rows) for part in parts], -2)


def at_rest(qpos: Tensor, qvel: Tensor) -> Motion:
    """The base itself, one body."""
    zero, still = qpos.new_zeros(3, 1, 1), qvel.new_zeros(3, 1, min(1, qvel.shape[-1]))
    return zero, eye_like(qpos)[..., None, None], still, still


def eye_like(x: Tensor) -> Tensor:
    """The identity ``(3, 3)`` with the dtype and device of ``x``."""
    return torch.eye(3, dtype=x.dtype, device=x.device)
