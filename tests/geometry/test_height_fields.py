"""Height fields against MuJoCo's rays and contacts, and against every triangle."""

import mujoco
import numpy as np
import pytest
import torch
from helpers import random_quats

from torchrl_nerd.geometry.rotations import rotate, rotate_inverse
from torchrl_nerd.geometry.surfaces import height_field_distance

HALF_X, HALF_Y, HEIGHT, REACH = 1.5, 1.0, 0.6, 0.4
FIELD = f"""
<mujoco><asset><hfield name="field" nrow="{{rows}}" ncol="{{columns}}"
    size="{HALF_X} {HALF_Y} {HEIGHT} 0.1"/></asset>
  <worldbody><body mocap="true"><geom name="field" type="hfield" hfield="field"/></body>
  <body><freejoint/><geom name="ball" size="0.25"/></body></worldbody></mujoco>"""
SHAPES = [(6, 9), (2, 2), (13, 3), (21, 31)]
each_grid = pytest.mark.parametrize("grid", SHAPES, ids=str)


def random_heights(grid, generator):
    """Rough ground that touches both limits, as the compiler would scale it."""
    heights = torch.rand(*grid, dtype=torch.float64, generator=generator)
    low, high = heights.min(), heights.max()
    return (HEIGHT * ((heights - low) / (high - low)).float()).double()


def compiled(heights):
    rows, columns = heights.shape
    xml = FIELD.format(rows=rows, columns=columns)
    model = mujoco.MjModel.from_xml_string(xml)
    model.hfield_data[:] = (heights / HEIGHT).reshape(-1).numpy()
    model.opt.ccd_tolerance, model.opt.ccd_iterations = 1e-10, 200
    return model, mujoco.MjData(model)


def random_points(count, generator, low=-0.3, high=1.0, beside=0.3):
    u = torch.rand(count, 3, dtype=torch.float64, generator=generator)
    size = torch.tensor([HALF_X + beside, HALF_Y + beside])
    points = (2.0 * u - 1.0) * torch.cat((size, torch.ones(1)))
    points[:, 2] = low + (high - low) * u[:, 2]
    return points


def distance_to(heights, points, reach=REACH):
    return height_field_distance(points, heights, HALF_X, HALF_Y, reach)


def triangles(heights):
    """All corners ``(T, 3, 3)``, cut from (r, c) to (r + 1, c + 1)."""
    rows, columns = heights.shape
    x = torch.linspace(-HALF_X, HALF_X, columns, dtype=torch.float64)
    y = torch.linspace(-HALF_Y, HALF_Y, rows, dtype=torch.float64)
    grid = torch.stack((*torch.meshgrid(x, y, indexing="xy"), heights), -1)
    start, end = grid[:-1, :-1], grid[1:, 1:]
    below = torch.stack((start, grid[:-1, 1:], end), 2)
    above = torch.stack((start, end, grid[1:, :-1]), 2)
    return torch.cat((below.flatten(0, 1), above.flatten(0, 1)))


def distance_to_triangles(points, corners):
    """Least distance by closest points on segments and by perpendicular feet."""
    best = torch.full((len(points),), torch.inf, dtype=torch.float64)
    for triangle in corners:
        for start, end in zip(triangle, triangle.roll(-1, 0), strict=True):
            along = end - start
            share = ((points - start) @ along / (along @ along)).clamp(0.0, 1.0)
            gap = points - start - share[:, None] * along
            best = torch.minimum(best, torch.linalg.vector_norm(gap, dim=-1))
        edges = torch.stack((triangle[1] - triangle[0], triangle[2] - triangle[0]), -1)
        shares = (points - triangle[0]) @ torch.linalg.pinv(edges).T
        gap = points - triangle[0] - shares @ edges.T
        is_on = (shares >= 0.0).all(-1) & (shares.sum(-1) <= 1.0)
        gap = torch.linalg.vector_norm(gap, dim=-1)
        best = torch.where(is_on, torch.minimum(best, gap), best)
    return best


@each_grid
def test_up_to_the_reach_no_triangle_is_closer(grid, generator):
    heights = random_heights(grid, generator)
    points = random_points(300, generator)
    distance, normal = distance_to(heights, points)
    want = distance_to_triangles(points, triangles(heights))
    near = want <= REACH
    assert near.sum() > 50
    torch.testing.assert_close(distance.abs()[near], want[near], rtol=0.0, atol=1e-12)
    assert (distance.abs() >= want - 1e-12).all()
    assert (distance.abs()[~near] >= REACH).all()
    closest = points - distance[:, None] * normal
    assert distance_to(heights, closest)[0].abs().max() < 1e-12


@each_grid
def test_a_point_is_inside_where_mujocos_ray_says_so(grid, generator):
    heights = random_heights(grid, generator)
    model, data = compiled(heights)
    mujoco.mj_kinematics(model, data)
    points = random_points(300, generator, beside=-1e-6)
    distance, _ = distance_to(heights, points)
    field, down = model.geom("field").id, np.array([0.0, 0.0, -1.0])
    for point, found in zip(points.numpy(), distance.numpy(), strict=True):
        start = np.array([point[0], point[1], 5.0])
        ray = mujoco.mj_rayHfield(model, data, field, start, down)
        assert ray > 0.0
        height = point[2] - (5.0 - ray)
        assert abs(height) < 1e-6 or (found < 0.0) == (height < 0.0)
        assert abs(found) <= abs(height) + 1e-6


def test_distance_and_normal_are_mujocos_contacts(generator):
    """A ball that touches, its centre outside, at random poses of the field."""
    heights = random_heights((6, 9), generator)
    model, data = compiled(heights)
    radius, seen = 0.25, 0
    points = random_points(400, generator, low=0.1, beside=-0.3)
    distance, normal = distance_to(heights, points)
    quats = random_quats(len(points), generator)
    places = rotate(quats, points)
    for index, found in enumerate(distance.tolist()):
        data.mocap_quat[0] = quats[index]
        data.qpos[:3] = places[index]
        mujoco.mj_fwdPosition(model, data)
        if found > radius + 1e-6:
            assert not data.ncon
            continue
        if not 0.02 < found < radius - 1e-6:
            continue
        deepest = min(data.contact[: data.ncon], key=lambda contact: contact.dist)
        assert abs(deepest.dist + radius - found) < 1e-5
        sign = 1.0 if deepest.geom1 == model.geom("field").id else -1.0
        towards = torch.from_numpy(sign * deepest.frame[:3])
        here = rotate_inverse(quats[index], towards)
        torch.testing.assert_close(here, normal[index], rtol=0.0, atol=1e-3)
        seen += 1
    assert seen > 50


@each_grid
def test_the_normal_is_the_slope_of_the_distance(grid, generator):
    heights = random_heights(grid, generator)
    points = random_points(200, generator).requires_grad_()
    distance, normal = distance_to(heights, points)
    (slope,) = torch.autograd.grad(distance.sum(), points)
    torch.testing.assert_close(slope, normal.detach(), rtol=0.0, atol=1e-11)


def test_flat_ground_is_a_plane(generator):
    heights = torch.full((5, 5), 0.3, dtype=torch.float64)
    points = random_points(100, generator, beside=0.0)
    distance, normal = distance_to(heights, points)
    torch.testing.assert_close(distance, points[:, 2] - 0.3, rtol=0.0, atol=1e-14)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand_as(normal)
    torch.testing.assert_close(normal, up, rtol=0.0, atol=1e-12)


def test_batches_are_rows_and_a_broken_point_stays_alone(generator):
    heights = random_heights((6, 9), generator)
    points = random_points(24, generator)
    flat, shaped = distance_to(heights, points), points.reshape(2, 3, 4, 3)
    for one, many in zip(flat, distance_to(heights, shaped), strict=True):
        assert torch.equal(one.reshape(many.shape), many)
    points[5] = torch.nan
    distance, _ = distance_to(heights, points)
    rest = torch.arange(24) != 5
    assert torch.equal(distance[rest], flat[0][rest]) and distance[5].isnan()
