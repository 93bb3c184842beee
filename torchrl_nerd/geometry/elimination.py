"""Solutions and inverses of mass matrices, all rows at once.

LAPACK takes them row by row, in calls that compiled code has to leave itself for. Where few
unknowns are compiled, Gauss's elimination without pivots, which positive definite matrices
need not, becomes one piece with what is round it. So does that of a robot whose equal limbs
know each other only through the trunk that carries them: limb by limb, then the trunk.
Source: Featherstone, Rigid Body Dynamics Algorithms, section 6.5 (branch-induced sparsity).
"""

from typing import NamedTuple

import mujoco
import numpy as np
import torch
from torch import Tensor

FEW = 8  # unknowns or columns; fourteen would take minutes to compile
FEWER = 6  # unknowns of an inverse; so would seven


def times(matrix: Tensor, rows: Tensor) -> Tensor:
    """``matrix (m, n)`` times each of ``rows (*size, n, N)``.

    Where few are compiled, sums, which become one piece with what is round them.
    """
    if matrix.shape[-1] <= FEW and torch.compiler.is_compiling():
        return (matrix[..., None] * rows.unsqueeze(-3)).sum(-2)
    return matrix @ rows


class Limbs(NamedTuple):
    """Dofs of a trunk, one after the other, then those of equal limbs, limb by limb."""

    trunk: int
    number: int
    size: int

    @classmethod
    def of(cls, model: mujoco.MjModel) -> "Limbs | None":
        """Of a robot that is built so, with few dofs in trunk and limb; else None."""
        parents, trunk = model.dof_parentid, 0
        while (parents == trunk - 1).sum() == 1:
            trunk += 1
        first = np.flatnonzero(parents == trunk - 1)
        sizes = np.diff([*first, model.nv])
        if not trunk or not len(first) or len({*sizes}) > 1:
            return None
        return (
            cls(trunk, len(first), int(sizes[0])) if max(trunk, *sizes) <= FEW else None
        )


def inverted(
    matrix: Tensor, right: Tensor, limbs: Limbs | None = None
) -> tuple[Tensor, Tensor]:
    """Inverses ``(n, n, N)`` of positive definite matrices, and times ``right (n, N)``."""
    is_compiling = torch.compiler.is_compiling()
    if is_compiling and len(matrix) <= FEWER:
        return _inverse(matrix), solve(matrix, right)
    if is_compiling and limbs is not None:
        inverse = _inverse_by_limbs(matrix, limbs)
        return inverse, (inverse * right).sum(1)
    inverse = torch.linalg.inv_ex(matrix.movedim(-1, 0))[0]
    return inverse.permute(1, 2, 0), (inverse @ right.mT[..., None])[..., 0].mT


def solve(matrix: Tensor, right: Tensor) -> Tensor:
    """Solutions ``(n, N)`` of positive definite ``(n, n, N)``."""
    if len(right) > FEW or not torch.compiler.is_compiling():
        return torch.linalg.solve_ex(matrix.movedim(-1, 0), right.mT)[0].mT
    return _eliminated(matrix, right)


def _eliminated(matrix: Tensor, right: Tensor) -> Tensor:
    """`solve` by Gauss's elimination."""
    columns, rows = [], []
    while len(right):
        row = matrix[0] / matrix[0, 0]
        columns.append(row[1:])
        rows.append(right[0] / matrix[0, 0])
        right = right[1:] - matrix[1:, 0] * rows[-1]
        matrix = matrix[1:, 1:] - matrix[1:, :1] * row[1:]
    found = [rows.pop()]
    while rows:
        column = columns[len(rows) - 1]
        found.insert(0, rows.pop() - (column * torch.stack(found)).sum(0))
    return torch.stack(found)


def _inverse(matrix: Tensor) -> Tensor:
    """Of few unknowns, ``(n, n, N)``."""
    one = torch.eye(len(matrix), dtype=matrix.dtype, device=matrix.device)
    return torch.stack([_eliminated(matrix, column[:, None]) for column in one], 1)


def _inverse_by_limbs(matrix: Tensor, limbs: Limbs) -> Tensor:
    """Of trunk and limbs, ``(n, n, N)``, from that of what limbs leave of the trunk."""
    trunk, number, size = limbs
    shape, rest = (number, size), matrix[trunk:, trunk:]
    between = matrix[:trunk, trunk:].unflatten(1, shape)  # (t, c, s, N)
    own = rest.unflatten(1, shape).unflatten(0, shape)
    own = own.diagonal(0, 0, 2).movedim(-1, 2)  # (s, s, c, N)
    lone = _inverse(own.flatten(2)).unflatten(2, (number, -1)).movedim(2, 0)
    pull = (between[:, :, :, None] * lone).sum(2)  # (t, c, s, N)
    flat, given = pull.flatten(1, 2), between.flatten(1, 2)
    left = matrix[:trunk, :trunk] - (flat[:, None] * given).sum(2)
    inverse = _inverse(left)
    cross = -(inverse[:, :, None] * flat).sum(1)  # (t, c s, N)
    limb = -(flat[:, :, None] * cross[:, None]).sum(0).unflatten(1, shape)
    limb = limb.unflatten(0, shape)  # (c, s, c, s, N)
    same = torch.eye(number, dtype=matrix.dtype, device=matrix.device)
    limb = limb + same[:, None, :, None, None] * lone[:, :, None]
    limb = limb.flatten(2, 3).flatten(0, 1)
    upper = torch.cat((inverse, cross), 1)
    return torch.cat((upper, torch.cat((cross.transpose(0, 1), limb), 1)))
