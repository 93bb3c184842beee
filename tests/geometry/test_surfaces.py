"""Ground surfaces against MuJoCo's own distances."""

import mujoco
import numpy as np
import torch
from helpers import random_quats

from torchrl_nerd.geometry.frames import rotate, rotate_inverse
from torchrl_nerd.geometry.kinematics import matrix_from_quat
from torchrl_nerd.geometry.surfaces import plane_distance, plane_in_frame

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
