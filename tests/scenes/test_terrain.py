"""Grounds: MuJoCo sees the plane that the parameters say."""

import mujoco
import numpy as np
import pytest
import torch

from torchrl_nerd.geometry.rotations import rotate
from torchrl_nerd.robots import load_scene
from torchrl_nerd.robots.double_pendulum.scene import (
    GROUNDS,
    LEVEL_TILT,
    evaluation_ground,
    sample_ground,
    sample_level_ground,
)
from torchrl_nerd.scenes.terrain import Terrain

ROWS = 400
ROOT = np.array([0.0, -1.0, 2.0])

EVALUATION_GROUNDS = [  # normal with y up, distance of the root
    ((0.0, 1.0, 0.0), 17.5),
    ((0.0, 1.0, 0.0), 2.0),
    ((-0.10702, 0.92069, 0.37533), 2.0326),
    ((0.0, 1.0, 0.0), 1.5),
    ((0.0, 1.0, 0.0), 2.5),
    ((0.0, 1.0, 0.0), 2.3),
    ((0.0, 0.92388, 0.38268), 2.2304),
]
"""The reference code's seven grounds as its robot sees them: where it puts the world's
origin, and so each plane's offset, does not matter."""


def tilted_planes(generator):
    """Planes tilted from straight down by 1e-12 rad up to straight up."""
    u = torch.rand(ROWS, 3, dtype=torch.float64, generator=generator)
    tilt, turn = 1e-12 * (np.pi * 1e12) ** u[:, 0], 2.0 * np.pi * u[:, 1]
    side = tilt.sin()
    normal = torch.stack((side * turn.cos(), side * turn.sin(), -tilt.cos()), -1)
    normal[:3] = torch.tensor([[0, 0, -1], [0, 0, 1], [1, 0, 0]])
    return torch.cat((normal, 10.0 * u[:, 2:] - 5.0), -1)


def mujoco_plane(scene, data, pose):
    """Normal and offset of the ground geom when the mocap body is at ``pose``."""
    data.mocap_pos[0], data.mocap_quat[0] = pose[:3], pose[3:]
    mujoco.mj_kinematics(scene.model, data)
    ground = scene.model.geom("ground").id
    normal = data.geom_xmat[ground].reshape(3, 3)[:, 2]
    return np.append(normal, normal @ data.geom_xpos[ground])


def clearances(scene, qpos, planes):
    """Least distance of both links' surfaces to each plane, by MuJoCo, m."""
    model, data = scene.model, mujoco.MjData(scene.model)
    ground, *links = (model.geom(name).id for name in ("ground", "link1", "link2"))
    found = []
    for q, pose in zip(qpos, scene.terrain.mocap_pose(planes).numpy(), strict=True):
        data.qpos, data.mocap_pos[0], data.mocap_quat[0] = q, pose[:3], pose[3:]
        mujoco.mj_kinematics(model, data)
        pairs = ((model, data, ground, link, 1e3, None) for link in links)
        found.append(min(mujoco.mj_geomDistance(*pair) for pair in pairs))
    return np.array(found)


def test_the_mocap_body_is_the_plane(generator):
    scene, planes = load_scene("double_pendulum"), tilted_planes(generator)
    data, poses = mujoco.MjData(scene.model), scene.terrain.mocap_pose(planes)
    for plane, pose in zip(planes.numpy(), poses.numpy(), strict=True):
        np.testing.assert_allclose(mujoco_plane(scene, data, pose), plane, 0.0, 1e-8)


def test_the_mocap_body_takes_the_shortest_turn(generator):
    terrain, planes = load_scene("double_pendulum").terrain, tilted_planes(generator)
    quat = terrain.mocap_pose(planes)[:, 3:]
    assert (torch.linalg.vector_norm(quat, dim=-1) - 1.0).abs().max() < 1e-14
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    torch.testing.assert_close(rotate(quat, up), planes[:, :3], rtol=0.0, atol=1e-8)
    assert (quat[:, 0] >= 0.0).all() and quat[:, 3].abs().max() < 1e-14


def test_the_files_plane_is_the_default():
    scene = load_scene("double_pendulum")
    assert scene.terrain.is_per_env
    np.testing.assert_allclose(scene.terrain.default, (0.0, 0.0, 1.0, 0.0))
    xml = """<mujoco><worldbody><body pos="1 2 3" quat="0.9 0.2 0.1 0.3">
      <geom type="plane" size="0 0 1" pos="0.1 0.2 0.3" quat="0.5 0.5 -0.2 0.1"/></body>
      </worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    terrain = Terrain.from_model(model, [0])
    normal, offset = terrain.fixed_plane[:3], terrain.fixed_plane[3]
    np.testing.assert_allclose(normal, data.geom_xmat[0].reshape(3, 3)[:, 2])
    np.testing.assert_allclose(offset, normal @ data.geom_xpos[0])
    assert not terrain.is_per_env and terrain.size == 0 and not len(terrain.default)


@pytest.mark.parametrize("number", range(7))
def test_evaluation_grounds_are_the_tables(number):
    (x, y, z), distance = EVALUATION_GROUNDS[number]
    plane = evaluation_ground(number).numpy()
    np.testing.assert_allclose(plane[:3], (x, -z, y), rtol=0.0, atol=6e-6)
    np.testing.assert_allclose(np.linalg.norm(plane[:3]), 1.0, rtol=1e-14)
    assert abs(plane[:3] @ ROOT - plane[3] - distance) < 6e-5


@pytest.mark.parametrize("number", [-1, 7])
def test_there_are_seven_evaluation_grounds(number):
    assert len(GROUNDS) == 7
    with pytest.raises(ValueError, match=f"from 0 to 6, got {number}"):
        evaluation_ground(number)


@pytest.mark.parametrize("sample", [sample_ground, sample_level_ground])
def test_sampled_grounds_reach_from_touching_to_out_of_reach(sample, generator):
    scene = load_scene("double_pendulum")
    qpos = scene.sample_initial(ROWS, generator)[0]["qpos"]
    planes = sample(qpos, generator)
    lengths = torch.linalg.vector_norm(planes[:, :3], dim=-1)
    assert (lengths - 1.0).abs().max() < 1e-14
    gap = clearances(scene, qpos, planes)
    assert gap.min() > -1e-9
    distance = planes[:, :3].numpy() @ ROOT - planes[:, 3].numpy()
    assert distance.max() <= 3.5 + 1e-12
    share = gap / (gap + 3.5 - distance)  # 0 touches now, 1 is 3.5 m from the root
    counts = np.histogram(share, bins=4, range=(0.0, 1.0))[0]
    assert counts.sum() == ROWS and counts.min() > 0.15 * ROWS


def test_sampled_normals_are_a_cubes(generator):
    planes = sample_ground(torch.zeros(20_000, 2).double(), generator)
    normal = planes[:, :3].abs()
    assert (planes[:, :3].mean(0).abs() < 0.03).all()
    # seen from its centre, each pair of a cube's faces fills a third of all directions
    share = torch.bincount(normal.argmax(-1), minlength=3) / len(normal)
    assert (share - 1.0 / 3.0).abs().max() < 0.02
    # uniform in the cube: more towards the corners than on a sphere
    assert (normal.amin(-1) > 0.4).double().mean() > 0.16


def test_level_grounds_are_hit_head_on(generator):
    planes = sample_level_ground(torch.zeros(20_000, 2).double(), generator)
    out_of_plane = planes[:, 1]
    assert out_of_plane.abs().max() <= np.sin(LEVEL_TILT)
    assert abs((out_of_plane == 0.0).double().mean() - 0.5) < 0.02
    assert (planes[:, :3].mean(0).abs() < 0.03).all()  # from above and below alike
