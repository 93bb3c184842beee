"""Robots against the published tables in ``published/``, by kinematics written again.

The joint-space mass matrix is the sum over links of J^T M J, the gravity force that of
-m J^T g, with Jacobians of a NumPy chain: nothing of MuJoCo goes in but the state.
"""

import copy
from math import pi
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from torchrl_nerd.data.generate import is_sound, simulate
from torchrl_nerd.robots import load_scene
from torchrl_nerd.robots.anymal.scene import LEGS, random_pd
from torchrl_nerd.robots.franka.scene import HOME

PUBLISHED = {
    path.stem: path for path in sorted((Path(__file__).parent / "published").glob("*"))
}
ARMATURE = {"ant": 0.01, "anymal": 0.06, "franka": 0.01, "franka_gravity": 0.1}
TOTAL_MASS = {  # kg
    "ant": 117.053,
    "anymal": 53.164,
    "franka": 18.7824,
    "franka_gravity": 16.6919 - 0.629769,  # without the fixed base
    "cube": 1.15102,
    "cube_real": 0.37,
    "cube_slope": 1.15102,
}
TIMING = {  # control step (s), substeps
    "ant": (1 / 60, 16),
    "anymal": (1 / 60, 10),
    "franka": (1 / 120, 9),
    "franka_gravity": (1 / 120, 9),
    "cube": (1 / 148, 20),
    "cube_real": (1 / 148, 20),
    "cube_slope": (1 / 148, 20),
}
POINTS_FOUND = {"ant": 25, "anymal": 14, "cube": 8, "cube_real": 8, "cube_slope": 8}
ANT_POSE = (0.0, 1.0, 0.0, -1.0, 0.0, -1.0, 0.0, 1.0)  # rad
ANYMAL_POSE = (  # rad, as the published policies run: LF, RF, LH, RH
    *(-0.03, -0.4, 0.8),
    *(0.03, -0.4, 0.8),
    *(-0.03, 0.4, -0.8),
    *(0.03, 0.4, -0.8),
)
STANDING = {  # height (m), pose
    "ant": (0.556, ANT_POSE),
    "anymal": (0.6230, ANYMAL_POSE),
    "cube": (0.0524, ()),
    "cube_real": (0.0524, ()),
    "cube_slope": (0.0524, ()),
}
every_table = pytest.mark.parametrize("name", PUBLISHED)


def matrix(quat):
    """Rotation matrix of a quaternion ``wxyz``."""
    w, *v = np.asarray(quat, float) / np.linalg.norm(quat)
    v, k = np.array(v), cross(v)
    return (w * w - v @ v) * np.eye(3) + 2.0 * np.outer(v, v) + 2.0 * w * k


def cross(v):
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]], float)


def turn(axis, angle):
    """Rotation about an axis, by Rodrigues' formula."""
    k = cross(axis)
    return np.eye(3) + np.sin(angle) * k + (1.0 - np.cos(angle)) * k @ k


def read_table(name):
    for line in PUBLISHED[name].read_text().splitlines():
        if line.startswith("#"):
            continue
        link, parent, *cells = (cell.strip() for cell in line.split("|"))
        cells = [None if c == "-" else np.array(c.split(), float) for c in cells]
        yield link, parent, *cells


def chain(name, qpos, gravity):
    """Mass matrix, gravity force and the pose of every link, from the table."""
    links = list(read_table(name))
    is_floating = links[0][4] is None
    nv = len(links) + (5 if is_floating else 0)
    mass_matrix, force = np.zeros((nv, nv)), np.zeros(nv)
    poses = {"world": (np.zeros(3), np.eye(3), [])}
    dof, q = 0, 0
    for link, parent, pos, quat, axis, mass, com, inertia in links:
        position, rotation, hinges = poses[parent]
        if axis is None:
            position, rotation, q = qpos[:3], matrix(qpos[3:7]), 7
            dof, hinges = 6, []
        else:
            position = position + rotation @ pos
            rotation = rotation @ matrix(quat)
            axis = axis / np.linalg.norm(axis)
            hinges = [*hinges, (dof, position, rotation @ axis)]
            rotation = rotation @ turn(axis, qpos[q])
            dof, q = dof + 1, q + 1
        poses[link] = position, rotation, hinges
        center = position + rotation @ com
        linear, angular = np.zeros((3, nv)), np.zeros((3, nv))
        if is_floating:
            origin, base, _ = poses[links[0][0]]
            linear[:, :3], angular[:, 3:6] = np.eye(3), base
            linear[:, 3:6] = -cross(center - origin) @ base
        for column, anchor, direction in hinges:
            linear[:, column] = np.cross(direction, center - anchor)
            angular[:, column] = direction
        xx, yy, zz, xy, xz, yz = inertia
        local = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        world = rotation @ local @ rotation.T
        mass_matrix += mass * linear.T @ linear + angular.T @ world @ angular
        force -= mass * linear.T @ gravity
    first = 6 if is_floating else 0
    mass_matrix[range(first, nv), range(first, nv)] += ARMATURE[name]
    return mass_matrix, force, poses


def random_pose(model, rng):
    qpos = model.qpos0.copy()
    mujoco.mj_integratePos(model, qpos, rng.normal(size=model.nv), 1.0)
    return qpos


@every_table
def test_mass_matrix_and_gravity_are_those_of_the_published_table(name, rng):
    model = load_scene(name).model
    data = mujoco.MjData(model)
    for _ in range(5):
        data.qpos = random_pose(model, rng)
        mujoco.mj_forward(model, data)
        got = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, got)
        want, force, poses = chain(name, data.qpos, model.opt.gravity)
        size = np.sqrt(np.outer(want.diagonal(), want.diagonal()))
        assert (abs(got - want) / size).max() < 1e-4
        largest = max(abs(force).max(), 1e-9)
        assert abs(data.qfrc_bias - force).max() < 1e-4 * largest
        for link, (position, rotation, _) in poses.items():
            np.testing.assert_allclose(data.body(link).xpos, position, atol=2e-5)
            got_axes = data.body(link).xmat.reshape(3, 3)
            np.testing.assert_allclose(got_axes, rotation, atol=2e-5)


@pytest.mark.parametrize("name", TOTAL_MASS)
def test_published_totals_and_time_steps(name):
    scene = load_scene(name)
    total = scene.model.body_mass.sum()
    np.testing.assert_allclose(total, TOTAL_MASS[name], rtol=1e-5)
    control_step, substeps = TIMING[name]
    assert abs(scene.control_step - control_step) < 1e-12
    assert scene.substeps == substeps
    assert len(scene.contacts.stands_for) == POINTS_FOUND.get(name, 0)
    gravity = 0.0 if name == "franka" else -9.81
    np.testing.assert_allclose(scene.model.opt.gravity, (0.0, 0.0, gravity))
    first = 6 if scene.base.is_floating else 0
    assert scene.actuated == list(range(first, scene.model.nv))


@pytest.mark.parametrize("name", ["cube", "cube_real"])
def test_published_numbers_of_the_cubes(name):
    model = load_scene(name).model
    inertia = {"cube": 0.002107, "cube_real": 0.00081}[name]
    np.testing.assert_allclose(model.body("cube").inertia, inertia)
    np.testing.assert_allclose(2.0 * model.geom("cube").size, 0.1048)
    assert model.nu == 0 and load_scene(name).sampling.torque == ()


def feet(name, qpos):
    """Where contact points of the last links are, base frame, m."""
    scene = load_scene(name)
    zero = torch.zeros(scene.model.nv, dtype=torch.float64)
    points, _ = scene.point_kinematics(torch.as_tensor(qpos), zero)
    return points.numpy()


def standing_qpos(name):
    height, pose = STANDING[name]
    return np.array([0.0, 0.0, height, 1.0, 0.0, 0.0, 0.0, *pose])


def test_published_places_of_the_feet():
    tips = feet("ant", standing_qpos("ant"))
    tips = tips[tips[:, 2] < -0.4]
    np.testing.assert_allclose(abs(tips), [[0.616, 0.616, 0.476]] * 4, atol=1e-3)
    assert len(np.unique(np.sign(tips[:, :2]), axis=0)) == 4
    soles = feet("anymal", standing_qpos("anymal"))
    soles = soles[soles[:, 2] < -0.5]
    np.testing.assert_allclose(abs(soles), [[0.4289, 0.2835, 0.5930]] * 4, atol=1e-3)
    names = [load_scene("anymal").model.joint(j).name for j in range(1, 13)]
    legs = [name.split("_")[0] for name in names[::3]]
    assert legs == ["LF", "RF", "LH", "RH"]
    assert [np.sign(foot[:2]).tolist() for foot in soles] == [
        *([1.0, 1.0], [1.0, -1.0]),
        *([-1.0, 1.0], [-1.0, -1.0]),
    ]


@pytest.mark.parametrize(
    ("name", "pose", "along", "place"),
    [
        ("franka", HOME, 0.21207, (0.3066, 0.0, 0.4845)),
        (
            "franka_gravity",
            (0.0, 0.0, 0.0, -1.57079, 0.0, 1.57079, -0.7853),
            0.107,
            (0.5545, 0.0, 0.6245),
        ),
    ],
)
def test_published_places_of_the_hand(name, pose, along, place):
    model = load_scene(name).model
    data = mujoco.MjData(model)
    data.qpos = pose
    mujoco.mj_kinematics(model, data)
    hand = data.body("link7")
    point = hand.xpos + along * hand.xmat.reshape(3, 3)[:, 2]
    np.testing.assert_allclose(point, place, atol=1e-3)


def test_published_joint_limits():
    hip, near, far = 2 * pi / 9, pi / 6, 5 * pi / 9
    legs = [(near, far), (-far, -near), (-far, -near), (near, far)]
    want = [limits for ankle in legs for limits in ((-hip, hip), ankle)]
    np.testing.assert_allclose(load_scene("ant").model.jnt_range[1:], want, atol=1e-6)
    model = load_scene("anymal").model
    for leg in LEGS:
        outward = (-0.72, 0.49) if leg.startswith("L") else (-0.49, 0.72)
        np.testing.assert_allclose(model.joint(f"{leg}_HAA").range, outward)
        assert not model.joint(f"{leg}_HFE").limited[0]
        assert not model.joint(f"{leg}_KFE").limited[0]
    assert not load_scene("franka").model.jnt_limited.any()
    assert load_scene("franka_gravity").model.jnt_limited.all()


@pytest.mark.parametrize("name", STANDING)
def test_a_robot_that_is_dropped_comes_to_rest_at_its_standing_height(name):
    model = copy.copy(load_scene(name).model)
    data = mujoco.MjData(model)
    data.qpos = model.qpos_spring[:] = standing_qpos(name)
    data.qpos[2] += 0.05
    # stiff joints, so that only the contact gives way
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model.jnt_stiffness[1:], model.dof_damping[6:] = 1e5, 1e3
    fastest = 0.0
    while data.time < 2.0:
        mujoco.mj_step(model, data)
        fastest = max(fastest, abs(data.qvel[2]))
    assert fastest < 1.1  # m/s: it falls 5 cm and never flies up again
    assert abs(data.qvel).max() < 1e-3
    assert abs(data.qpos[2] - STANDING[name][0]) < 6e-3
    assert abs(data.qpos[3]) > 0.999


@pytest.mark.parametrize("name", POINTS_FOUND)
def test_standing_height_is_where_the_lowest_point_touches(name):
    qpos = torch.as_tensor(standing_qpos(name))
    clearance = load_scene(name).clearances(qpos)
    assert abs(clearance.min()) < 2e-4
    assert (clearance < 1e-3).sum() == 4


def test_random_trajectories_stay_sound_and_their_starts_in_range(scene, generator):
    data = simulate(scene, 32, 60, generator)
    assert is_sound(data).all()
    start, ranges = data[:, 0], scene.sampling
    first_q, first_v = (7, 6) if ranges.base else (0, 0)
    qpos, qvel = start["qpos"][:, first_q:], start["qvel"][:, first_v:]
    for values, low, high in (
        (qpos, ranges.qpos_low, ranges.qpos_high),
        (qvel, ranges.qvel_low, ranges.qvel_high),
    ):
        assert (values >= values.new_tensor(low)).all()
        assert (values <= values.new_tensor(high)).all()
    if ranges.base:
        place = start["qpos"][:, :3]
        assert (place >= place.new_tensor(ranges.base.low)).all()
        assert (place <= place.new_tensor(ranges.base.high)).all()
    if ranges.clearance:
        assert (scene.clearances(start["qpos"]) >= ranges.clearance).all()


def test_random_springs_of_anymal(generator):
    rows = 2000
    draw = torch.rand(rows, 25, dtype=torch.float64, generator=generator) - 0.5
    qpos, qvel = torch.zeros(rows, 19).double(), torch.zeros(rows, 18).double()
    qpos[:, 7:] = qpos.new_tensor(ANYMAL_POSE)
    scale = torch.ones(rows, 1).double()
    scale[:500], scale[500:1000] = 0.0, draw[500:1000, :1].abs()
    torque = random_pd(qpos, qvel, scale, generator)
    assert not torque[:500].any()
    quiet = torque[500:1000].abs() / scale[500:1000]
    assert 40.0 < quiet.max() <= 85.0 * 0.5
    violent = torque[1000:].abs()
    assert 85.0 < violent.max() <= 200.0 * 0.5
    state = generator.get_state()
    qvel[:, 6:] = draw[:, :12]
    still = random_pd(qpos, 0.0 * qvel, scale, generator)
    generator.set_state(state)
    moving = random_pd(qpos, qvel, scale, generator)
    damping = (still - moving) / qvel[:, 6:]
    torch.testing.assert_close(damping[500:1000], torch.full((500, 12), 2.0).double())
    low, high = 30.0 / 120, 1.0 + 200.0 / 120  # U(0, 1) and what the hold takes away
    assert (damping[1000:] > low - 1e-9).all() and (damping[1000:] < high + 1e-9).all()
