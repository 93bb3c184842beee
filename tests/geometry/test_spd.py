"""What compiled code does in place of LAPACK gives what LAPACK gives."""

import mujoco
import numpy as np
import pytest
import torch
from helpers import slow_but
from torch import Tensor

from torchrl_nerd.geometry.spd import (
    MAX_SOLVE,
    BranchSparsity,
    matvec,
    spd_inverse,
    spd_solve,
)
from torchrl_nerd.robots import load_scene

CLOSE = {"atol": 1e-9, "rtol": 1e-9}


def traced(function):
    return torch.compile(function, backend="eager", fullgraph=True)


def drawn(size: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Positive definite ``(n, n, N)``, and right sides ``(n, N)``."""
    half = torch.randn(5, size, size, dtype=torch.float64, generator=generator)
    matrix = half @ half.mT + torch.eye(size)
    right = torch.randn(size, 5, dtype=torch.float64, generator=generator)
    return matrix.movedim(0, -1), right


SIZES = 1, 2, MAX_SOLVE, MAX_SOLVE + 1, 14
SHAPES = (6, 4, 2), (1, 3, 4), (7, 2, 8)


@pytest.mark.parametrize("size", slow_but((2, 14), SIZES))
def test_few_unknowns_or_many(size, generator):
    matrix, right = drawn(size, generator)
    inverse = torch.linalg.inv(matrix.movedim(-1, 0))
    expected = (inverse @ right.mT[..., None])[..., 0].mT
    for each in (spd_solve, traced(spd_solve)):
        torch.testing.assert_close(each(matrix, right), expected, **CLOSE)
    for each in (spd_inverse, traced(spd_inverse)):
        found = each(matrix, right)
        torch.testing.assert_close(found[0], inverse.movedim(0, -1), **CLOSE)
        torch.testing.assert_close(found[1], expected, **CLOSE)


@pytest.mark.parametrize("columns", [1, MAX_SOLVE, MAX_SOLVE + 1])
def test_few_columns_or_many(columns, generator):
    matrix = torch.randn(3, columns, dtype=torch.float64, generator=generator)
    rows = torch.randn(2, 4, columns, 5, dtype=torch.float64, generator=generator)
    expected = torch.einsum("mn,abnk->abmk", matrix, rows)
    for each in (matvec, traced(matvec)):
        torch.testing.assert_close(each(matrix, rows), expected, **CLOSE)


@pytest.mark.parametrize(("root", "count", "size"), slow_but(SHAPES[:1], SHAPES))
def test_branch_by_branch(root, count, size, generator):
    branches = BranchSparsity(root, count, size)
    matrix, right = drawn(root + count * size, generator)
    branch = torch.tensor([-1] * root + [k for k in range(count) for _ in range(size)])
    is_apart = (branch[:, None] != branch) & (branch[:, None] >= 0) & (branch >= 0)
    matrix = matrix.masked_fill(is_apart[..., None], 0.0)
    matrix = matrix + 50.0 * torch.eye(len(matrix))[..., None]  # still definite
    expected = spd_inverse(matrix, right)
    found = traced(spd_inverse)(matrix, right, branches)
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, **CLOSE)


@pytest.mark.parametrize("name", ["ant", "anymal"])
def test_a_robots_branches_are_coupled_through_the_root_alone(name, generator):
    """MuJoCo's mass matrix is zero between them."""
    model = load_scene(name).model
    branches = BranchSparsity.of(model)
    assert branches is not None
    root, count, size = branches
    assert root + count * size == model.nv
    data = mujoco.MjData(model)
    data.qpos[:] += torch.randn(model.nq, generator=generator).numpy()
    mujoco.mj_forward(model, data)
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    blocks = torch.from_numpy(full[root:, root:])
    blocks = blocks.unflatten(1, (count, size)).unflatten(0, (count, size))
    for k in range(count):
        for other in range(count):
            assert blocks[k, :, other].any() == (k == other)


def test_robots_of_another_build_have_none():
    def branches(body: str) -> BranchSparsity | None:
        xml = f"<mujoco><worldbody>{body}</worldbody></mujoco>"
        return BranchSparsity.of(mujoco.MjModel.from_xml_string(xml))

    hinge, geom = '<joint axis="0 1 0"/>', '<geom size="0.1"/>'
    arm, free = f"<body>{hinge}{geom}</body>", f"<freejoint/>{geom}"
    leg = f"<body>{hinge}{geom}{arm}</body>"
    assert branches(f"<body>{free}{leg}{leg}</body>") == (6, 2, 2)
    assert branches(f"<body>{hinge}{geom}{arm}{arm}{arm}</body>") == (1, 3, 1)
    for body in (
        f"<body>{free}{leg}{arm}</body>",  # unequal
        f"<body>{free}{geom}</body>",  # none
        arm + arm,  # no root
        leg,  # a chain
    ):
        assert branches(body) is None
