"""Ground surfaces against MuJoCo's own distances."""

import mujoco
import numpy as np
import torch
from helpers import random_quats

from torchrl_nerd.geometry.rotations import matrix_from_quat, rotate, rotate_inverse
from torchrl_nerd.geometry.surfaces import (
    box_distance,
    into_frame,
    plane_distance,
    plane_in_frame,
)

ROWS, POINTS, RADIUS = 30, 5, 0.1
BALL = f"""
<mujoco><worldbody>
  <body mocap="true"><geom name="plane" type="plane" size="0 0 1"/></body>
  <body mocap="true"><geom name="ball" size="{RADIUS}"/></body>
</worldbody></mujoco>"""


def random_planes(rows, generator):
    """Quaternion, a point of the plane, and the plane's parameters."""
    quat = random_quats(rows, generator)
    origin = 3.0 * torch.randn(rows, 3, dtype=torch.float64, generator=generator)
    normal = rotate(quat, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    offset = (normal * origin).sum(-1, keepdim=True)
    return quat, origin, torch.cat((normal, offset), -1)


def random_points(generator):
    return 3.0 * torch.randn(ROWS, POINTS, 3, dtype=torch.float64, generator=generator)


def test_distance_to_a_plane_is_mujocos(generator):
    model = mujoco.MjModel.from_xml_string(BALL)
    data, segment = mujoco.MjData(model), np.empty(6)
    plane, ball = model.geom("plane").id, model.geom("ball").id
    quat, origin, planes = random_planes(ROWS, generator)
    points = random_points(generator)
    distance, _ = plane_distance(points, planes)
    for row in range(ROWS):
        data.mocap_pos[0], data.mocap_quat[0] = origin[row], quat[row]
        for index in range(POINTS):
            data.mocap_pos[1] = points[row, index]
            mujoco.mj_kinematics(model, data)
            clearance = mujoco.mj_geomDistance(model, data, plane, ball, 1e3, segment)
            assert abs(clearance + RADIUS - float(distance[row, index])) < 1e-12


def test_closest_points_lie_on_the_plane(generator):
    _, origin, planes = random_planes(ROWS, generator)
    points = random_points(generator)
    distance, normal = plane_distance(points, planes)
    assert normal.shape == points.shape
    closest = points - distance[..., None] * normal
    off_plane = ((closest - origin[:, None]) * normal).sum(-1)
    assert off_plane.abs().max() < 1e-13
    unit = torch.linalg.vector_norm(normal, dim=-1)
    torch.testing.assert_close(unit, torch.ones_like(unit), rtol=0.0, atol=1e-14)


def test_a_plane_seen_from_any_frame_is_the_same_plane(generator):
    _, _, planes = random_planes(ROWS, generator)
    turn = random_quats(ROWS, generator)
    position = torch.randn(ROWS, 3, dtype=torch.float64, generator=generator)
    points = random_points(generator)
    points_f = rotate_inverse(turn[:, None], points - position[:, None])
    plane_f = plane_in_frame(planes, position, matrix_from_quat(turn))
    distance, normal = plane_distance(points, planes)
    distance_f, normal_f = plane_distance(points_f, plane_f)
    torch.testing.assert_close(distance_f, distance, rtol=0.0, atol=1e-13)
    torch.testing.assert_close(
        rotate(turn[:, None], normal_f), normal, rtol=0.0, atol=1e-14
    )


HALF = torch.tensor([0.5, 1.0, 0.3], dtype=torch.float64)
BOX = """
<mujoco><worldbody>
  <body mocap="true"><geom name="box" type="box" size="0.5 1 0.3"/></body>
  <body mocap="true"><geom name="ball" size="1e-3"/></body>
</worldbody></mujoco>"""


def points_about(generator):
    """Points in and round a box, in its frame."""
    reach = 1.5 * HALF.max()
    u = torch.rand(ROWS, POINTS, 3, dtype=torch.float64, generator=generator)
    return reach * (2.0 * u - 1.0)


def test_distance_from_outside_is_mujocos(generator):
    model = mujoco.MjModel.from_xml_string(BOX)
    model.opt.ccd_tolerance = 1e-12
    data, segment = mujoco.MjData(model), np.empty(6)
    box, ball = model.geom("box").id, model.geom("ball").id
    quat, origin, _ = random_planes(ROWS, generator)
    local = points_about(generator)
    distance, normal = box_distance(local, HALF)
    points = rotate(quat[:, None], local) + origin[:, None]
    normal = rotate(quat[:, None], normal)
    seen = 0
    for row, index in (distance > 2e-3).nonzero().tolist():
        data.mocap_pos[0], data.mocap_quat[0] = origin[row], quat[row]
        data.mocap_pos[1] = points[row, index]
        mujoco.mj_kinematics(model, data)
        gap = mujoco.mj_geomDistance(model, data, box, ball, 1e3, segment)
        assert abs(gap + 1e-3 - float(distance[row, index])) < 1e-6
        away = (segment[3:] - segment[:3]) / np.linalg.norm(segment[3:] - segment[:3])
        np.testing.assert_allclose(normal[row, index], away, rtol=0.0, atol=2e-3)
        seen += 1
    assert seen > 0.2 * ROWS * POINTS


def test_distance_is_to_the_closest_point(generator):
    """No point of the surface is closer, and the one that is named is on it."""
    points = points_about(generator).reshape(-1, 3)
    distance, normal = box_distance(points, HALF)
    closest = points - distance[:, None] * normal
    assert box_distance(closest, HALF)[0].abs().max() < 1e-13
    around = 2.0 * torch.randn(2000, 3, dtype=torch.float64, generator=generator)
    gap, outward = box_distance(around, HALF)
    surface = around - gap[:, None] * outward
    gaps = torch.cdist(points, surface).amin(-1)
    assert (gaps >= distance.abs() - 1e-12).all()
    length = torch.linalg.vector_norm(normal, dim=-1)
    torch.testing.assert_close(length, torch.ones_like(length), rtol=0.0, atol=1e-13)


def test_the_normal_is_the_slope_of_the_distance(generator):
    points = points_about(generator).requires_grad_()
    distance, normal = box_distance(points, HALF)
    (slope,) = torch.autograd.grad(distance.sum(), points)
    torch.testing.assert_close(slope, normal.detach(), rtol=0.0, atol=1e-12)


def test_centres_edges_and_corners_have_finite_slopes():
    signs = torch.tensor([[0, 0, 0], [1, 1, 1], [1, 0, 0], [0, 1, -1], [0, 0, -0.5]])
    points = (signs * HALF)[None].requires_grad_()
    distance, normal = box_distance(points, HALF)
    (slope,) = torch.autograd.grad((distance + normal.sum(-1)).sum(), points)
    length = torch.linalg.vector_norm(normal, dim=-1)
    torch.testing.assert_close(length, torch.ones_like(length))
    assert slope.isfinite().all()


def test_a_frames_points_are_the_worlds(generator):
    turn, origin, _ = random_planes(ROWS, generator)
    base, position, _ = random_planes(ROWS, generator)
    points = random_points(generator)
    there, rotation = into_frame(
        points, position, matrix_from_quat(base), origin, matrix_from_quat(turn)
    )
    world = rotate(base[:, None], points) + position[:, None]
    want = rotate_inverse(turn[:, None], world - origin[:, None])
    torch.testing.assert_close(there, want, rtol=0.0, atol=1e-13)
    back = (there - there[:, :1]) @ rotation
    torch.testing.assert_close(back, points - points[:, :1], rtol=0.0, atol=1e-13)
