"""Solutions and inverses of symmetric positive definite (SPD) matrices, batch last.

Eager code calls LAPACK. torch.compile cannot fuse LAPACK calls, so compiled code of few
unknowns eliminates without pivoting, which SPD matrices do not need. A legged robot's mass
matrix is block-sparse: its equal limbs are coupled through the root alone, so the limbs are
eliminated first, then the root.
Source: Featherstone, Rigid Body Dynamics Algorithms, section 6.5 (branch-induced sparsity).
"""

from typing import NamedTuple

import mujoco
import numpy as np
import torch
from torch import Tensor

MAX_SOLVE = 8  # unknowns or columns to unroll; fourteen take minutes to compile
MAX_INVERSE = 6  # unknowns of an inverse to unroll; seven take minutes


def matvec(matrix: Tensor, rows: Tensor) -> Tensor:
    """``matrix (m, n)`` times each of ``rows (*size, n, N)``.

    Small compiled products are sums, which fuse with the code around them.
    """
    if matrix.shape[-1] <= MAX_SOLVE and torch.compiler.is_compiling():
        return (matrix[..., None] * rows.unsqueeze(-3)).sum(-2)
    return matrix @ rows


class BranchSparsity(NamedTuple):
    """Dofs of a root chain, then those of equal branches, branch by branch."""

    root_dofs: int
    num_branches: int
    branch_dofs: int

    @classmethod
    def of(cls, model: mujoco.MjModel) -> "BranchSparsity | None":
        """Of a robot of that shape, with few dofs in root and branch; else None."""
        parents, root = model.dof_parentid, 0
        while (parents == root - 1).sum() == 1:
            root += 1
        first = np.flatnonzero(parents == root - 1)
        sizes = np.diff([*first, model.nv])
        if not root or len({*sizes}) != 1 or max(root, *sizes) > MAX_SOLVE:
            return None
        return cls(root, len(first), int(sizes[0]))


def spd_inverse(
    matrix: Tensor, right: Tensor, branches: BranchSparsity | None = None
) -> tuple[Tensor, Tensor]:
    """Inverses ``(n, n, N)`` of positive definite matrices, and times ``right (n, N)``."""
    is_compiling = torch.compiler.is_compiling()
    if is_compiling and len(matrix) <= MAX_INVERSE:
        return _inverse(matrix), spd_solve(matrix, right)
    if is_compiling and branches is not None:
        inverse = _inverse_by_branches(matrix, branches)
        return inverse, (inverse * right).sum(1)
    inverse = torch.linalg.inv_ex(matrix.movedim(-1, 0))[0]
    return inverse.permute(1, 2, 0), (inverse @ right.mT[..., None])[..., 0].mT


def spd_solve(matrix: Tensor, right: Tensor) -> Tensor:
    """Solutions ``(n, N)`` of positive definite ``(n, n, N)``."""
    if len(right) > MAX_SOLVE or not torch.compiler.is_compiling():
        return torch.linalg.solve_ex(matrix.movedim(-1, 0), right.mT)[0].mT
    return _eliminate(matrix, right)


def _eliminate(matrix: Tensor, right: Tensor) -> Tensor:
    """Solutions by Gauss's elimination: forward, then back substitution."""
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
    return torch.stack([_eliminate(matrix, column[:, None]) for column in one], 1)


def _inverse_by_branches(matrix: Tensor, branches: BranchSparsity) -> Tensor:
    """Inverse ``(n, n, N)`` from that of the root's Schur complement."""
    root, number, size = branches
    shape, rest = (number, size), matrix[root:, root:]
    # t dofs of the root, c branches of s dofs each
    between = matrix[:root, root:].unflatten(1, shape)  # (t, c, s, N)
    own = rest.unflatten(1, shape).unflatten(0, shape)
    own = own.diagonal(0, 0, 2).movedim(-1, 2)  # (s, s, c, N)
    lone = _inverse(own.flatten(2)).unflatten(2, (number, -1)).movedim(2, 0)
    pull = (between[:, :, :, None] * lone).sum(2)  # (t, c, s, N)
    flat, given = pull.flatten(1, 2), between.flatten(1, 2)
    left = matrix[:root, :root] - (flat[:, None] * given).sum(2)
    inverse = _inverse(left)
    cross = -(inverse[:, :, None] * flat).sum(1)  # (t, c s, N)
    limb = -(flat[:, :, None] * cross[:, None]).sum(0).unflatten(1, shape)
    limb = limb.unflatten(0, shape)  # (c, s, c, s, N)
    same = torch.eye(number, dtype=matrix.dtype, device=matrix.device)
    limb = limb + same[:, None, :, None, None] * lone[:, :, None]
    limb = limb.flatten(2, 3).flatten(0, 1)
    upper = torch.cat((inverse, cross), 1)
    return torch.cat((upper, torch.cat((cross.transpose(0, 1), limb), 1)))
