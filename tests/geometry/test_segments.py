"""The shortest way between segments, against MuJoCo's capsules and a search."""

import mujoco
import numpy as np
import torch

from torchrl_nerd.geometry.segments import between_segments

ROWS = 400
RADIUS = 1e-3  # m: of the capsules that MuJoCo measures


def segments(generator, *size):
    return torch.randn(*size, 4, 3, dtype=torch.float64, generator=generator)


def degenerate(generator):
    """Points, parallel, collinear, crossing and coinciding segments among random ones."""
    a, b, c, d = segments(generator, ROWS).unbind(1)
    kind = torch.arange(ROWS)[:, None] % 8
    d = torch.where(kind == 1, c + 1.7 * (b - a), d)  # parallel
    c = torch.where(kind == 2, a + 0.4 * (b - a), c)  # one begins on the other
    b = torch.where((kind == 3) | (kind == 4), a, b)  # a point
    d = torch.where((kind == 4) | (kind == 5), c, d)  # two points; the other one
    c, d = (torch.where(kind == 6, x, y) for x, y in ((a, c), (b, d)))  # the same
    return a, b, c, d


def test_distances_are_those_of_mujocos_capsules(generator):
    spec = mujoco.MjSpec()
    for name in ("first", "second"):
        body = spec.worldbody.add_body(name=name, mocap=True)
        body.add_geom(
            name=name,
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            fromto=(0, 0, -0.5, 0, 0, 0.5),
            size=(RADIUS, 0, 0),
        )
    model = spec.compile()
    data = mujoco.MjData(model)
    place = torch.randn(ROWS, 2, 3, dtype=torch.float64, generator=generator)
    turn = torch.randn(ROWS, 2, 4, dtype=torch.float64, generator=generator)
    turn[::5, 1] = turn[::5, 0]  # parallel
    for row in range(ROWS):
        data.mocap_pos, data.mocap_quat = place[row].numpy(), turn[row].numpy()
        mujoco.mj_kinematics(model, data)
        axes = torch.from_numpy(data.geom_xmat.reshape(2, 3, 3)[:, :, 2] / 2.0)
        (a, c), (b, d) = place[row] - axes, place[row] + axes
        way, *_ = between_segments(a, b, c, d)
        want = mujoco.mj_geomDistance(model, data, 0, 1, 10.0, None)
        assert abs(float(way.norm()) - 2.0 * RADIUS - want) < 1e-12


def test_no_other_points_are_nearer_and_the_way_leads_between_those_named(generator):
    a, b, c, d = ends = degenerate(generator)
    way, first, second = between_segments(*ends)
    assert ((0.0 <= first) & (first <= 1.0) & (0.0 <= second) & (second <= 1.0)).all()
    start, end = a + first * (b - a), c + second * (d - c)
    torch.testing.assert_close(way, end - start)
    grid = torch.from_numpy(np.linspace(0.0, 1.0, 41))[:, None, None]
    there, other = a + grid * (b - a), c + grid * (d - c)  # (41, ROWS, 3)
    nearest = (there[:, None] - other).norm(dim=-1).amin((0, 1))
    assert (way.norm(dim=-1) <= nearest + 1e-12).all()
