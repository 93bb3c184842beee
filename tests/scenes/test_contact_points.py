"""What can touch the ground, what is left out of it, and that nothing is lost."""

import copy
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from helpers import every_scene, make_scene, random_states, random_transitions

from torchrl_nerd.geometry.base import Base
from torchrl_nerd.keys import CONTACT_DISTANCE, CONTACT_NORMAL, QPOS, QVEL, TERRAIN
from torchrl_nerd.robots import SCENES, load_scene
from torchrl_nerd.robots.double_pendulum.scene import (
    GROUNDS,
    RADIUS,
    ROOT,
    evaluation_ground,
)
from torchrl_nerd.scenes.contact_points import (
    MARGIN_PER_RADIUS,
    MAX_POINTS,
    MIN_MARGIN,
    TOLERANCE,
    contact_points,
    ground_geoms,
    own_contacts,
    shape_points,
    terrain_geoms,
    touching_geoms,
)
from torchrl_nerd.scenes.importer import read_mjcf
from torchrl_nerd.scenes.shapes import shape_balls
from torchrl_nerd.transforms import ContactFeatures

PLANE = '<geom type="plane" size="0 0 1"/>'
SHAPES = {
    "sphere": ('type="sphere" size="0.2"', 1, 0.2),
    "capsule": ('type="capsule" size="0.1 0.3"', 2, 0.1),
    "box": ('type="box" size="0.1 0.2 0.3"', 8, 0.0),
}


def one_shape(shape, ground=PLANE):
    """A floating base of one shape, off its origin and turned."""
    body = f'<geom name="foot" {shape} pos="0.1 -0.2 0.3" quat="0.7 0.1 -0.3 0.4"/>'
    body = f'<body pos="0 0 2"><freejoint/>{body}</body>'
    return make_scene(f"<mujoco><worldbody>{ground}{body}</worldbody></mujoco>")


def world_points(model, qpos, bodies, places):
    """Points in the world by MuJoCo at every row of ``qpos``, ``(rows, P, 3)``."""
    data, found = mujoco.MjData(model), []
    for row in qpos:
        data.qpos = row
        mujoco.mj_kinematics(model, data)
        turns = data.xmat[bodies].reshape(-1, 3, 3)
        found.append(data.xpos[bodies] + np.einsum("pij,pj->pi", turns, places))
    return np.array(found)


@pytest.mark.parametrize("shape", SHAPES)
def test_the_nearest_point_gives_a_shapes_clearance(shape, rng):
    attributes, count, radius = SHAPES[shape]
    scene = one_shape(attributes)
    model, points = scene.model, scene.contacts
    assert len(points) == len(points.stands_for) == count
    assert (points.radii == radius).all()
    data, poses = mujoco.MjData(model), random_states(model, 30, rng)[0].numpy()
    places = world_points(model, poses, points.bodies, points.positions)
    for pose, height in zip(poses, places[..., 2], strict=True):
        data.qpos = pose
        mujoco.mj_kinematics(model, data)
        want = mujoco.mj_geomDistance(model, data, 0, 1, 1e3, None)
        assert abs((height - points.radii).min() - want) < 1e-12


@every_scene
def test_margins_are_the_papers(scene):
    points = scene.contacts
    want = np.maximum(MARGIN_PER_RADIUS * points.radii, MIN_MARGIN)
    np.testing.assert_array_equal(points.margins, want)
    assert (MARGIN_PER_RADIUS, MIN_MARGIN) == (4.0, 0.1)
    assert len(points) <= len(points.stands_for)


def test_pendulum_keeps_elbow_and_tip():
    scene = load_scene("double_pendulum")
    points, model = scene.contacts, scene.model
    places = world_points(model, np.zeros((1, 2)), points.bodies, points.positions)[0]
    order = np.argsort(places[:, 0])
    np.testing.assert_allclose(places[order], [[1.5, -1, 2], [3.0, -1, 2]], atol=1e-12)
    np.testing.assert_allclose(points.radii, 0.1)
    assert len(points.stands_for) == 4


def test_merged_points_never_part(rng):
    model = load_scene("double_pendulum").model
    ends = [model.body("link1").id, model.body("link2").id]
    qpos = 3.0 * random_states(model, 30, rng)[0].numpy()
    places = world_points(model, qpos, ends, [[1.5, 0, 0], [0, 0, 0]])
    np.testing.assert_allclose(places[:, 0], places[:, 1], rtol=0.0, atol=1e-14)


def test_the_papers_contacts_follow_from_the_pendulums_features(generator):
    scene = load_scene("double_pendulum")
    model, points, root = scene.model, scene.contacts, scene.fixed_base_pose[0]
    rows = random_transitions(scene, 400, generator)
    qpos, planes = rows[QPOS].numpy(), rows[TERRAIN].numpy()
    transform = ContactFeatures(scene)
    values = transform.contact_features(rows[QPOS], rows[QVEL], rows[TERRAIN])
    features = dict(zip(transform.out_keys, values, strict=True))
    below = features[CONTACT_DISTANCE].numpy()
    normals = features[CONTACT_NORMAL].unflatten(-1, (-1, 3)).numpy()
    bodies = [model.body(f"link{number}").id for number in (1, 1, 2, 2)]
    caps = [[0, 0, 0], [1.5, 0, 0], [0, 0, 0], [1.5, 0, 0]]  # all four, as in the paper
    found = world_points(model, qpos, bodies, caps) - root
    kept = world_points(model, qpos, points.bodies, points.positions) - root
    rebuilt = 0
    for row, (n, offset) in enumerate((plane[:3], plane[3]) for plane in planes):
        distance = found[row] @ n + root @ n - offset
        is_seen = distance < 0.4
        if not is_seen[1:].any():
            assert not below[row].any()  # all there is to see is the unmoving root
            continue
        index = below[row].argmin()
        normal = normals[row, index] / np.linalg.norm(normals[row, index])
        d = (found[row] - kept[row, index]) @ normal
        d += below[row, index] + points.margins[index]
        p1 = found[row] - d[:, None] * normal
        np.testing.assert_allclose(normal, n, 0.0, 1e-9)
        np.testing.assert_allclose(d[is_seen], distance[is_seen], 0.0, 1e-9)
        closest = found[row] - distance[:, None] * n
        np.testing.assert_allclose(p1[is_seen], closest[is_seen], 0.0, 1e-9)
        rebuilt += 1
    assert rebuilt > 10


def test_a_ground_that_only_a_dropped_point_touches_does_nothing(rng):
    """The pendulum's root: its links point away from a plane that it dips into.

    Without friction, which would brake its cap; no ground in use reaches it, see below.
    """
    scene = load_scene("double_pendulum")
    model, terrain = copy.copy(scene.model), scene.terrain
    model.geom_friction[:] = 0.0
    model.geom_condim[:] = 1
    for _ in range(20):
        angle, depth = rng.uniform(-np.pi, np.pi), rng.uniform(0.0, 0.05)
        normal = np.array([np.cos(angle), 0.0, np.sin(angle)])
        qpos, qvel, after = np.array([angle, 0.0]), rng.normal(size=2), []
        for distance in (0.1 - depth, 10.0):
            plane = torch.tensor([*normal, 2.0 * normal[2] - distance])
            pose = terrain.mocap_pose(plane.double()).numpy()
            data = mujoco.MjData(model)
            data.mocap_pos[0], data.mocap_quat[0] = pose[:3], pose[3:]
            data.qpos, data.qvel = qpos, qvel
            mujoco.mj_step(model, data)
            after.append(data.qvel.copy())
            assert data.ncon == (distance < 0.1)
        np.testing.assert_allclose(after[0], after[1], rtol=0.0, atol=1e-9)


def test_no_ground_in_use_reaches_the_dropped_root_of_the_pendulum(generator):
    scene = load_scene("double_pendulum")
    planes = [evaluation_ground(number)[None] for number in range(len(GROUNDS))]
    planes.append(scene.sample_initial(500, generator)[0]["terrain"])
    plane = torch.cat(planes)
    distance = plane[:, :3] @ torch.tensor(ROOT).double() - plane[:, 3]
    assert (distance > RADIUS - 1e-9).all()


CLOUD = " ".join(f"{x:.4f}" for x in np.random.default_rng(3).normal(0, 0.1, 240))
ROUND = {
    "wheel": 'type="cylinder" size="0.2 0.05"',
    "rod": 'type="cylinder" size="0.02 0.4"',
    "egg": 'type="ellipsoid" size="0.1 0.15 0.3"',
    "pancake": 'type="ellipsoid" size="0.2 0.05 0.2"',
    "ball": 'type="ellipsoid" size="0.1 0.1 0.1"',
    "cloud": 'type="mesh" mesh="cloud"',
}


def check_distances(model, points, error, rng, rows=200):
    """The lowest point is where MuJoCo has the lowest shape, or above by the error."""
    bodies, positions, radii = points
    data, poses = mujoco.MjData(model), random_states(model, rows, rng)[0].numpy()
    places = world_points(model, poses, bodies, positions)
    (ground,), over = terrain_geoms(model), []
    for pose, height in zip(poses, places[..., 2], strict=True):
        data.qpos = pose
        mujoco.mj_kinematics(model, data)
        want = min(
            mujoco.mj_geomDistance(model, data, ground, geom, 1e3, None)
            for geom in touching_geoms(model)
        )
        over.append((height - radii).min() - want)
    assert min(over) > -1e-6 and max(over) < error + 1e-6
    return max(over)


def one_round_shape(shape):
    body = f'<geom name="foot" {shape} pos="0.1 -0.2 0.3" quat="0.7 0.1 -0.3 0.4"/>'
    return make_scene(
        f"""<mujoco><asset><mesh name="cloud" vertex="{CLOUD}"/></asset><worldbody>
        {PLANE}<body pos="0 0 2"><freejoint/>{body}</body></worldbody></mujoco>"""
    )


@pytest.mark.parametrize("most", [6, 1000])
@pytest.mark.parametrize("shape", ROUND)
def test_few_points_stand_for_a_shape_up_to_the_error_they_state(shape, most, rng):
    scene = replace(one_round_shape(ROUND[shape]), max_contact_points=most)
    points = scene.contacts
    assert len(points) <= most
    if most > len(points):
        own = shape_balls(scene.model, 1)[2]
        assert points.error <= own + TOLERANCE and own < 0.005
    places = points.bodies, points.positions, points.radii
    worst = check_distances(scene.model, places, points.error, rng)
    if len(points) == most > 1:
        assert worst > 0.05 * points.error  # it is no idle bound


def test_the_ball_of_a_round_ellipsoid_is_it():
    points = one_round_shape(ROUND["ball"]).contacts
    assert len(points) == 1 and points.error < 1e-15
    assert abs(points.radii[0] - 0.1) < 1e-15


PLANE_TYPE = mujoco.mjtGeom.mjGEOM_PLANE
FOUND = sorted((Path(__file__).parents[2] / "../shared/robots").glob("*/*.xml"))


@pytest.mark.skipif(not FOUND, reason="no third-party robots here")
@pytest.mark.parametrize("path", FOUND, ids=lambda path: path.parent.name)
def test_third_party_robots_are_where_mujoco_has_them(path, rng):
    """Cylinders, boxes and meshes of real robots, and MuJoCo's own distances."""
    model, _ = read_mjcf(path, None)
    if not terrain_geoms(model):
        model, _ = read_mjcf(path, None, "plane")
    points = contact_points(model, Base.from_model(model))
    assert len(points) <= MAX_POINTS and points.error < 0.1
    if (model.geom_type[terrain_geoms(model)] == PLANE_TYPE).all():
        check_distances(model, shape_points(model)[:3], points.error, rng, rows=30)


def test_only_what_can_touch_has_points():
    ball = 'type="sphere" size="0.2"'
    assert len(one_shape(f'{ball} contype="2" conaffinity="4"').contacts) == 0
    assert len(one_shape(f'{ball} contype="0" conaffinity="1"').contacts) == 1
    assert one_shape(ball, ground="").terrain is None


def test_only_what_the_robot_can_touch_is_ground():
    ball = 'type="sphere" size="0.2"'
    filtered = '<geom type="cylinder" size="1 1" contype="2" conaffinity="2"/>'
    assert len(one_shape(ball, PLANE + filtered).terrain.surfaces) == 1
    assert len(one_shape(ball, PLANE + PLANE).terrain.surfaces) == 2


EXCLUDING = """<mujoco><worldbody><geom type="plane" size="1 1 1"/>
  <body name="a" pos="0 0 1"><joint/><geom size="0.1"/>
    <body name="b"><geom size="0.1"/><body name="c"><joint/><geom size="0.1"/>
      <body name="d"><joint/><geom size="0.1"/></body></body>
      <body name="e"><joint/><geom size="0.1"/></body></body></body>
  <body name="f"><joint/><geom name="f" size="0.1" contype="0" conaffinity="0"/></body>
  <body name="g"><joint/><geom name="g" size="0.1" contype="2" conaffinity="1"/></body>
  </worldbody><contact><exclude body1="c" body2="e"/><pair geom1="f" geom2="g"/></contact>
  <option><flag {flag}="disable"/></option></mujoco>"""
OTHERS = ("dm_control/walker-walk", "dm_control/humanoid-run", "gymnasium/Ant-v5")


@pytest.mark.parametrize(
    "model",
    [
        *(load_scene(name).model for name in (*SCENES, *OTHERS)),
        *(
            mujoco.MjModel.from_xml_string(EXCLUDING.format(flag=flag))
            for flag in ("filterparent", "contact", "gravity")
        ),
    ],
    ids=[*SCENES, *OTHERS, "no parent filter", "no contact", "excluding"],
)
def test_own_contacts_are_mujocos(model):
    """Shapes that feel each other from ten metres off: all that may touch, do."""
    model = copy.copy(model)
    model.geom_margin[:] = model.body_margin[:] = 10.0
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    moves = model.body_dofnum[model.body_weldid[model.geom_bodyid]] > 0
    found = {tuple(sorted(pair)) for pair in data.contact.geom.tolist()}
    found = {pair for pair in found if moves[list(pair)].all()}
    assert {tuple(sorted(pair)) for pair in own_contacts(model)} == found


WITH_FLOOR = """<mujoco><worldbody>
  <geom name="floor" type="plane" size="0 0 1"/>
  <body name="fixed" pos="2 0 0"><geom type="box" size="1 1 1" contype="4"/></body>
  <body name="a" pos="0 0 2"><freejoint/><geom name="a" size="0.1"/>
    <body name="b"><joint axis="0 1 0"/><geom name="b" size="0.1"/></body>
    <body name="c"><joint axis="1 0 0"/><geom name="c" size="0.1" contype="0"
      conaffinity="0"/></body>
    <body name="d"><joint axis="0 0 1"/><geom name="d" size="0.1" contype="0"
      conaffinity="4"/></body></body>
  </worldbody><contact><exclude body1="world" body2="b"/>{pairs}</contact></mujoco>"""
PAIRS = ("", '<pair geom1="floor" geom2="c"/>', '<pair geom1="b" geom2="floor"/>')


@pytest.mark.parametrize("pairs", PAIRS, ids=["none", "unlike", "excluded"])
def test_the_ground_s_contacts_are_mujocos(pairs):
    """Excluded bodies do not touch it, and explicit pairs always do."""
    model = mujoco.MjModel.from_xml_string(WITH_FLOOR.format(pairs=pairs))
    wide = copy.copy(model)
    wide.geom_margin[:] = 10.0
    wide.pair_margin[:] = 10.0
    data = mujoco.MjData(wide)
    mujoco.mj_forward(wide, data)
    moves = model.body_dofnum[model.body_weldid[model.geom_bodyid]] > 0
    found = [pair for pair in data.contact.geom.tolist() if moves[pair].sum() == 1]
    grounds, robots = (
        {geom for pair in found for geom in pair if moves[geom] == kind}
        for kind in (False, True)
    )
    assert set(ground_geoms(model)) == grounds
    bodies = shape_points(model)[0]
    assert set(bodies) == {int(model.geom_bodyid[geom]) for geom in robots}
