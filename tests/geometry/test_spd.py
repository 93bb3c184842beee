"""What compiled code does in place of LAPACK gives what LAPACK gives."""

import mujoco
import pytest
import torch
from helpers import every_scene
from torch import Tensor

from torchrl_nerd.geometry.spd import FEW, Limbs, inverted, solve, times

CLOSE = {"atol": 1e-9, "rtol": 1e-9}


def traced(function):
    return torch.compile(function, backend="eager", fullgraph=True)


def drawn(size: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Positive definite ``(n, n, N)``, and right sides ``(n, N)``."""
    half = torch.randn(5, size, size, dtype=torch.float64, generator=generator)
    matrix = half @ half.mT + torch.eye(size)
    right = torch.randn(size, 5, dtype=torch.float64, generator=generator)
    return matrix.movedim(0, -1), right


@pytest.mark.parametrize("size", [1, 2, FEW, FEW + 1, 14])
def test_few_unknowns_or_many(size, generator):
    matrix, right = drawn(size, generator)
    inverse = torch.linalg.inv(matrix.movedim(-1, 0))
    expected = (inverse @ right.mT[..., None])[..., 0].mT
    for each in (solve, traced(solve)):
        torch.testing.assert_close(each(matrix, right), expected, **CLOSE)
    for each in (inverted, traced(inverted)):
        found = each(matrix, right)
        torch.testing.assert_close(found[0], inverse.movedim(0, -1), **CLOSE)
        torch.testing.assert_close(found[1], expected, **CLOSE)


@pytest.mark.parametrize("columns", [1, FEW, FEW + 1])
def test_few_columns_or_many(columns, generator):
    matrix = torch.randn(3, columns, dtype=torch.float64, generator=generator)
    rows = torch.randn(2, 4, columns, 5, dtype=torch.float64, generator=generator)
    expected = torch.einsum("mn,abnk->abmk", matrix, rows)
    for each in (times, traced(times)):
        torch.testing.assert_close(each(matrix, rows), expected, **CLOSE)


@pytest.mark.parametrize("limbs", [Limbs(6, 4, 2), Limbs(1, 3, 4), Limbs(7, 2, 8)])
def test_limb_by_limb(limbs, generator):
    trunk, count, size = limbs
    matrix, right = drawn(trunk + count * size, generator)
    limb = torch.tensor([-1] * trunk + [k for k in range(count) for _ in range(size)])
    is_apart = (limb[:, None] != limb) & (limb[:, None] >= 0) & (limb >= 0)
    matrix = matrix.masked_fill(is_apart[..., None], 0.0)
    matrix = matrix + 50.0 * torch.eye(len(matrix))[..., None]  # still definite
    expected = inverted(matrix, right)
    for one, other in zip(
        traced(inverted)(matrix, right, limbs), expected, strict=True
    ):
        torch.testing.assert_close(one, other, **CLOSE)


@every_scene
def test_a_robots_limbs_know_each_other_through_the_trunk_alone(scene, generator):
    """Those that are found are MuJoCo's: its mass matrix is zero between them."""
    model, limbs = scene.model, Limbs.of(scene.model)
    if limbs is None:
        assert scene.name not in ("ant", "anymal")
        return
    trunk, count, size = limbs
    assert trunk + count * size == model.nv
    data = mujoco.MjData(model)
    data.qpos[:] += torch.randn(model.nq, generator=generator).numpy()
    mujoco.mj_forward(model, data)
    force, columns = torch.eye(model.nv, dtype=torch.float64).numpy(), []
    for unit in force:
        column = torch.zeros(model.nv, dtype=torch.float64).numpy()
        mujoco.mj_mulM(model, data, column, unit)
        columns.append(torch.from_numpy(column))
    matrix = torch.stack(columns)[trunk:, trunk:]
    blocks = matrix.unflatten(1, (count, size)).unflatten(0, (count, size))
    for k in range(count):
        for other in range(count):
            assert blocks[k, :, other].any() == (k == other)


def test_robots_of_another_build_have_none():
    def limbs(body: str) -> Limbs | None:
        xml = f"<mujoco><worldbody>{body}</worldbody></mujoco>"
        return Limbs.of(mujoco.MjModel.from_xml_string(xml))

    hinge, geom = '<joint axis="0 1 0"/>', '<geom size="0.1"/>'
    arm, free = f"<body>{hinge}{geom}</body>", f"<freejoint/>{geom}"
    leg = f"<body>{hinge}{geom}{arm}</body>"
    assert limbs(f"<body>{free}{leg}{leg}</body>") == Limbs(6, 2, 2)
    assert limbs(f"<body>{hinge}{geom}{arm}{arm}{arm}</body>") == Limbs(1, 3, 1)
    for body in (
        f"<body>{free}{leg}{arm}</body>",  # unequal
        f"<body>{free}{geom}</body>",  # none
        arm + arm,  # no trunk
        leg,  # a chain
    ):
        assert limbs(body) is None
