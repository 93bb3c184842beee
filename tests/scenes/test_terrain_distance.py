"""Ground of several surfaces, fixed and per env, against MuJoCo's own distances."""

import copy
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
from helpers import make_scene, random_quats
from tensordict import TensorDict

from torchrl_nerd.dynamics import DMControlDynamics, MujocoDynamics
from torchrl_nerd.geometry.rotations import quat_multiply, rotate
from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.transforms import ContactFeatures

ROWS = 20
ROBOT = """<body name="robot" pos="0 0 1"><freejoint/>
  <geom type="sphere" size="0.05" pos="0.2 0 0"/>
  <geom type="capsule" size="0.03 0.2" pos="-0.1 0.1 0" quat="0.8 0.2 0.4 0.1"/></body>"""
GROUNDS = {
    "slope": '<body mocap="true"><geom type="plane" size="0 0 1"/></body>',
    "set-in slope": """<body mocap="true" pos="0.1 0.2 0"><geom type="plane"
        size="0 0 1" pos="0.1 0.2 -0.3" quat="0.9 0.1 -0.3 0.2"/></body>""",
    "step": """<geom type="plane" size="0 0 1"/>
        <geom type="box" size="1 2 0.3" pos="1 0 0" quat="0.95 0.1 0 0.2"/>""",
    "trench": """<geom type="plane" size="0 0 1" quat="0.9 0.3 0 0" pos="0 0.1 -1"/>
        <geom type="plane" size="0 0 1" quat="0.9 -0.3 0 0" pos="0 0.1 -1"/>""",
    "slope and step": """<geom type="plane" size="0 0 1" pos="0 0 -1"/>
        <body mocap="true"><geom type="plane" size="0 0 1"/></body>
        <geom type="box" size="0.5 1 0.3" pos="1 0 0"/>""",
    "two slopes": """<body mocap="true"><geom type="plane" size="0 0 1"/></body>
        <body mocap="true" pos="9 9 9"/>
        <body mocap="true"><body pos="0 0.3 0">
          <geom type="plane" size="0 0 1" pos="0 0 -0.5"/></body></body>""",
}
WIDTHS = {"slope": 4, "set-in slope": 4, "slope and step": 4, "two slopes": 8}
each_ground = pytest.mark.parametrize("ground", GROUNDS)


def scene_over(ground):
    xml = f"<mujoco><worldbody>{GROUNDS[ground]}{ROBOT}</worldbody></mujoco>"
    return make_scene(xml, ground)


def random_places(rows, generator, spread=0.7):
    """Poses ``(rows, 7)`` near the origin, any way up."""
    position = torch.randn(rows, 3, dtype=torch.float64, generator=generator)
    return torch.cat((spread * position, random_quats(rows, generator)), -1)


def random_terrain(scene, rows, generator):
    parts = [torch.zeros(rows, 0).double()]
    for _ in scene.terrain.planes:
        pose = random_places(rows, generator)
        normal = rotate(pose[:, 3:], torch.tensor([0.0, 0.0, 1.0]).double())
        offset = (normal * pose[:, :3]).sum(-1, keepdim=True)
        parts.append(torch.cat((normal, offset), 1))
    return torch.cat(parts, -1)


def place(scene, data, qpos, terrain):
    """MuJoCo's data with the robot and the env's ground where they should be."""
    pose, count = scene.terrain.mocap_pose(terrain).numpy(), 3 * scene.model.nmocap
    data.qpos = qpos.numpy()
    if count:
        data.mocap_pos.flat, data.mocap_quat.flat = pose[:count], pose[count:]
    mujoco.mj_kinematics(scene.model, data)


def least_distance(scene, data, point, radius):
    """MuJoCo's least distance from a ball at the point, and its direction or None."""
    model, segment = copy.copy(scene.model), np.empty(6)
    data, found = copy.copy(data), []
    ball = model.geom_bodyid.tolist().index(
        model.body("robot").id
    )  # the robot's sphere
    model.geom_size[ball, 0] = radius
    data.geom_xpos[ball] = point
    for geom in range(model.ngeom):
        if model.geom_bodyid[geom] != model.body("robot").id:
            gap = mujoco.mj_geomDistance(model, data, geom, ball, 1e3, segment)
            away = segment[3:] - segment[:3]
            found.append((gap, np.sign(gap) * away / np.linalg.norm(away)))
    return min(found, key=lambda entry: entry[0])


@each_ground
def test_distance_and_normal_are_mujocos(ground, generator):
    scene = scene_over(ground)
    model, data = scene.model, mujoco.MjData(scene.model)
    assert len(scene.contacts) == 3
    assert scene.terrain.size == WIDTHS.get(ground, 0)
    qpos, terrain = (
        random_places(ROWS, generator),
        random_terrain(scene, ROWS, generator),
    )
    pose = scene.base_pose(qpos)
    points, _ = scene.point_kinematics(qpos, torch.zeros(ROWS, model.nv).double())
    distance, normal = scene.terrain_distance(points, terrain, *pose)
    radii = torch.from_numpy(scene.contacts.radii)
    gaps = scene.clearances(qpos, terrain)
    torch.testing.assert_close(gaps, distance - radii, rtol=0.0, atol=0.0)
    world = points @ pose[1].mT + pose[0][:, None]
    normal = normal @ pose[1].mT
    seen = 0
    for row in range(ROWS):
        place(scene, data, qpos[row], terrain[row])
        for index in (distance[row] > 2e-3).nonzero()[:, 0].tolist():
            gap, away = least_distance(scene, data, world[row, index], 1e-3)
            assert abs(gap + 1e-3 - float(distance[row, index])) < 1e-5
            np.testing.assert_allclose(normal[row, index], away, rtol=0.0, atol=5e-3)
            seen += 1
    assert seen > ROWS / 4


@each_ground
def test_features_move_with_robot_and_ground(ground, generator):
    """Any rigid motion of both, tilts included: contact knows no up."""
    scene = scene_over(ground)
    model = copy.copy(scene.model)
    turn, shift = random_quats(1, generator)[0], 3.0 * torch.randn(3).double()
    for geom in (model.geom_bodyid == 0).nonzero()[0]:
        position, quat = (
            torch.from_numpy(x[geom]) for x in (model.geom_pos, model.geom_quat)
        )
        model.geom_pos[geom] = rotate(turn, position) + shift
        model.geom_quat[geom] = quat_multiply(turn, quat)
    model.geom_sameframe[model.geom_bodyid == 0] = 0  # or MuJoCo skips the new pose
    elsewhere = replace(scene, model=model)
    states = random_places(ROWS, generator)
    qvel = torch.randn(ROWS, 6, dtype=torch.float64, generator=generator)
    terrain = random_terrain(scene, ROWS, generator)

    def moved(pose):
        position = rotate(turn, pose[..., :3]) + shift
        return torch.cat((position, quat_multiply(turn, pose[..., 3:])), -1)

    parts = [torch.zeros(ROWS, 0).double()]
    for plane in scene.terrain.split(terrain):
        normal = rotate(turn, plane[:, :3])
        offset = plane[:, 3] + (normal * shift).sum(-1)
        parts.append(torch.cat((normal, offset[:, None]), -1))
    speed = torch.cat((rotate(turn, qvel[:, :3]), qvel[:, 3:]), -1)
    want = ContactFeatures(scene).contact_features(states, qvel, terrain)
    got = ContactFeatures(elsewhere).contact_features(
        moved(states), speed, torch.cat(parts, -1)
    )
    assert any(value.any() for value in want)
    for one, other in zip(got, want, strict=True):
        torch.testing.assert_close(one, other, rtol=0.0, atol=1e-10)


@each_ground
def test_every_ground_has_the_same_features(ground):
    """The width does not depend on the number or kind of surfaces."""
    sizes = ContactFeatures(scene_over(ground)).sizes
    assert sizes == ContactFeatures(scene_over("slope")).sizes
    assert ("terrain" in ContactFeatures(scene_over(ground)).in_keys) == (
        ground in WIDTHS
    )


@each_ground
def test_without_parameters_the_ground_is_the_files(ground, generator):
    scene = scene_over(ground)
    qpos = random_places(ROWS, generator)
    default = torch.from_numpy(scene.terrain.default).expand(ROWS, -1)
    assert torch.equal(scene.clearances(qpos), scene.clearances(qpos, default))
    data, fresh = mujoco.MjData(scene.model), mujoco.MjData(scene.model)
    mujoco.mj_kinematics(scene.model, fresh)
    place(scene, data, torch.from_numpy(scene.model.qpos0), default[0])
    planes = scene.model.geom_type == 0
    normals = (x.geom_xmat.reshape(-1, 3, 3)[planes, :, 2] for x in (data, fresh))
    np.testing.assert_allclose(*normals, rtol=0.0, atol=1e-9)
    others = (x.geom_xpos[~planes] for x in (data, fresh))
    np.testing.assert_allclose(*others, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("ground", ["slope and step", "two slopes"])
def test_both_mujoco_dynamics_put_the_ground_in_place(ground, generator):
    scene = scene_over(ground)
    terrain = random_terrain(scene, 6, generator)
    state = {QPOS: random_places(6, generator), QVEL: torch.zeros(6, 6).double()}
    state, torque = TensorDict(state, [6]), torch.zeros(6, 0).double()
    after = MujocoDynamics(scene, num_threads=1).step(state, torque, terrain)
    rows = DMControlDynamics(scene)
    rows.reset(state)
    again = rows.step(state, torque, terrain)
    model = scene.model
    for row in range(6):
        data = mujoco.MjData(model)
        place(scene, data, state[QPOS][row], terrain[row])
        mujoco.mj_step(model, data, scene.substeps)
        for found in (after, again):
            np.testing.assert_allclose(found[QPOS][row], data.qpos, 0.0, 1e-9)


@pytest.mark.parametrize("dynamics", [MujocoDynamics, DMControlDynamics])
def test_bad_terrain_is_refused_in_one_sentence(dynamics, generator):
    scene = scene_over("two slopes")
    state = {QPOS: random_places(3, generator), QVEL: torch.zeros(3, 6).double()}
    state, torque = TensorDict(state, [3]), torch.zeros(3, 0).double()
    physics, terrain = dynamics(scene), random_terrain(scene, 3, generator)
    for wrong in (terrain[:, :4], terrain[:2], terrain[0]):
        with pytest.raises(ValueError, match=r"terrain of shape \(3, 8\), got \("):
            physics.step(state, torque, wrong)
    terrain[1, 5] = torch.nan
    with pytest.raises(
        ValueError, match="finite terrain, got NaN or infinity in env 1"
    ):
        physics.step(state, torque, terrain)
    with pytest.raises(ValueError, match="finite terrain"):
        scene.terrain.mocap_pose(terrain)


@pytest.mark.parametrize("kind", ["cylinder", "sphere"])
def test_a_floating_base_needs_ground_of_a_known_shape(kind):
    geom = f'<geom name="stump" type="{kind}" size="0.1 0.2 0.3"/>'
    xml = f"<mujoco><worldbody>{geom}{ROBOT}</worldbody></mujoco>"
    with pytest.raises(
        ValueError, match=f"ground of another shape .*'stump' of 'world', a {kind}"
    ):
        _ = make_scene(xml).terrain


def test_a_mocap_body_with_more_than_a_plane_is_refused():
    plane = '<geom type="plane" size="0 0 1"/>'
    arm = '<body><joint/><geom size="0.1" contype="0"/></body>'
    for more in (plane, '<geom type="box" size="1 1 1"/>', arm):
        body = f'<body mocap="true">{plane}{more}</body>'
        xml = f"<mujoco><worldbody>{body}{ROBOT}</worldbody></mujoco>"
        with pytest.raises(ValueError, match="one plane on a mocap body"):
            _ = make_scene(xml).terrain


def test_a_box_on_a_mocap_body_stands_where_the_file_has_it():
    """Nothing moves it, so it is as fixed as one of the world."""
    box = '<body {} pos="0 0.1 0.2"><geom type="box" size="1 1 0.1"/></body>'
    at, surfaces = 'mocap="true"', []
    for kind in (at, ""):
        xml = f"<mujoco><worldbody>{box.format(kind)}{ROBOT}</worldbody></mujoco>"
        (surface,) = make_scene(xml).terrain.surfaces
        surfaces.append(surface)
    assert surfaces[0].mocap == -1
    np.testing.assert_array_equal(surfaces[0].position, surfaces[1].position)


def test_the_hash_sees_the_ground_and_the_robots_does_not():
    scenes = [scene_over(ground) for ground in GROUNDS]
    field = (
        """<mujoco><asset><hfield name="a" nrow="3" ncol="3" size="1 1 1 1"
        elevation="0 0 0 0 {} 0 0 0 1"/></asset><worldbody>
        <geom type="hfield" hfield="a"/>"""
        + f"{ROBOT}</worldbody></mujoco>"
    )
    scenes += [make_scene(field.format(height)) for height in (0.2, 0.3)]
    fixed = GROUNDS["two slopes"].replace('mocap="true" ', "")
    xml = f"<mujoco><worldbody>{fixed}{ROBOT}</worldbody></mujoco>"
    scenes.append(make_scene(xml))
    assert len({scene.hash for scene in scenes}) == len(scenes)
    assert len({scene.robot_hash for scene in scenes}) == 1
    heavier = copy.copy(scenes[0].model)
    heavier.body_mass[-1] *= 1.01
    assert replace(scenes[0], model=heavier).robot_hash != scenes[0].robot_hash
