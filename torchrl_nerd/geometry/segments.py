"""Closest points of line segments, batched: the axes of capsules."""

import torch
from torch import Tensor

SHORTEST = 1e-24  # m^2: squares of lengths below it are those of a point
PARALLEL = 1e-12  # squared sine of an angle that rounding cannot tell from none


def between_segments(
    start: Tensor, end: Tensor, other_start: Tensor, other_end: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """The shortest way from each segment to another one, and where it begins and ends.

    All ends are ``(*batch, 3)``, m; a point is a segment of no length. Of parallel segments
    it is one of the shortest. Source: Ericson, "Real-Time Collision Detection" (2005),
    section 5.1.9.

    Returns:
        ``(*batch, 3)``, m, and the shares ``(*batch, 1)`` of either segment, in [0, 1].
    """
    along, other = end - start, other_end - other_start
    offset = start - other_start
    a, e = (_dot(x, x).clamp_min(SHORTEST) for x in (along, other))
    b, c, f = _dot(along, other), _dot(along, offset), _dot(other, offset)
    determinant = a * e - b * b
    is_parallel = determinant <= PARALLEL * a * e
    first = (b * f - c * e) / torch.where(is_parallel, 1.0, determinant)
    first = first.clamp(0.0, 1.0)
    second = ((b * first.masked_fill(is_parallel, 0.0) + f) / e).clamp(0.0, 1.0)
    first = ((b * second - c) / a).clamp(0.0, 1.0)
    way = torch.lerp(other_start, other_end, second) - torch.lerp(start, end, first)
    return way, first, second


def _dot(x: Tensor, y: Tensor) -> Tensor:
    return (x * y).sum(-1, keepdim=True)
