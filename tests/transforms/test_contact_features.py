"""What contact points see of the ground, against MuJoCo; continuous everywhere."""

from functools import cache

import mujoco
import numpy as np
import pytest
import torch
from helpers import (
    HANDMADE,
    every_scene,
    make_scene,
    moved_rows,
    moved_scene,
    mujoco_step,
    random_transitions,
    with_points_in_order,
)
from tensordict import TensorDict

from torchrl_nerd.keys import (
    CONTACT_DEPTH,
    CONTACT_DISTANCE,
    CONTACT_FORCE,
    CONTACT_NORMAL,
    CONTACT_VELOCITY,
    JOINT_TORQUE,
    QPOS,
    QVEL,
    TERRAIN,
)
from torchrl_nerd.robots import SCENES, load_scene
from torchrl_nerd.transforms import ContactFeatures, RobotCentric, StateDelta

ROWS, FADE = 150, 0.25
TOUCHING = [*(load_scene(name) for name in SCENES), *HANDMADE.values()]
TOUCHING = {scene.name: scene for scene in TOUCHING if scene.terrain is not None}
touching_scene = pytest.mark.parametrize("scene", TOUCHING.values(), ids=TOUCHING)


def contact_features(scene, rows):
    """Features of points in float64, by key, ``(rows, points, -1)``."""
    transform, count = ContactFeatures(scene), len(scene.contacts)
    ground, torque = rows.get(TERRAIN, None), rows.get(JOINT_TORQUE, None)
    values = transform.contact_features(rows[QPOS], rows[QVEL], ground, torque)
    found = dict(zip(transform.out_keys, values, strict=True))
    found.pop(CONTACT_FORCE, None)  # of joints, see test_ground_force.py
    return {key: value.unflatten(-1, (count, -1)) for key, value in found.items()}


@cache
def data_of(scene):
    return mujoco.MjData(scene.model)


def mujoco_contacts(scene, row):
    """Distance and velocity of every point, the ground's normal, the base's axes."""
    model, points, data = scene.model, scene.contacts, data_of(scene)
    fixed = scene.terrain.fixed_plane
    plane = row[TERRAIN].numpy() if fixed is None else fixed
    data.qpos, data.qvel = row[QPOS].numpy(), row[QVEL].numpy()
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    distances, velocities = [], []
    for body, place in zip(points.bodies, points.positions, strict=True):
        world = data.xpos[body] + data.xmat[body].reshape(3, 3) @ place
        jacobian = np.empty((3, model.nv))
        mujoco.mj_jac(model, data, jacobian, None, world, body)
        distances.append(plane[:3] @ world - plane[3])
        velocities.append(jacobian @ data.qvel)
    turn = data.xmat[scene.base.body].reshape(3, 3)
    turn = turn if scene.base.is_floating else scene.fixed_base_pose[1]
    return np.array(distances), np.array(velocities), plane[:3], turn


def is_raisable(scene):
    return not scene.base.others and (
        scene.terrain.is_per_env or scene.base.is_floating
    )


def near_ground(scene, generator):
    """Random rows that touch or nearly do, where the robot can be raised."""
    rows, points = random_transitions(scene, ROWS, generator), scene.contacts
    if not is_raisable(scene):
        return rows
    gap = [min(mujoco_contacts(scene, row)[0] - points.radii) for row in rows]
    height = 0.1 * torch.rand(ROWS, dtype=torch.float64, generator=generator) - 0.05
    return raised(scene, rows, height - torch.tensor(gap))


def raised(scene, rows, height):
    """The ground lowered by ``height (rows,)``, or the robot raised by it."""
    rows = rows.clone()
    if scene.terrain.is_per_env:
        rows[TERRAIN][:, 3] -= height
    else:
        rows[QPOS][:, scene.base.qpos_address + 2] += height
    return rows


@touching_scene
def test_features_are_mujocos_distances_and_velocities(scene, generator):
    rows, seen = near_ground(scene, generator), 0
    features, points = contact_features(scene, rows), scene.contacts
    for index in range(ROWS):
        distance, velocity, normal, turn = mujoco_contacts(scene, rows[index])
        beyond = distance - points.margins
        gate = np.clip(beyond / (FADE * (points.radii - points.margins)), 0.0, 1.0)
        speed = velocity @ normal
        sliding = (velocity - speed[:, None] * normal) @ turn
        want = {
            CONTACT_DISTANCE: np.minimum(beyond, 0.0)[:, None],
            CONTACT_VELOCITY: gate[:, None] * np.column_stack((speed, sliding)),
            CONTACT_NORMAL: gate[:, None] * (normal @ turn),
        }
        for key in features.keys() & want.keys():
            np.testing.assert_allclose(features[key][index], want[key], 0.0, 1e-9)
        now = gate * np.maximum(points.radii - distance, 0.0)
        np.testing.assert_allclose(features[CONTACT_DEPTH][index, :, 0], now, 0.0, 1e-9)
        seen += (gate > 0.0).sum()
    assert seen > 10


@touching_scene
def test_predicted_depths_are_those_of_the_coming_states(scene, generator):
    """At constant velocity; along unconstrained motion, see test_feature_config."""
    rows, predicted = near_ground(scene, generator), 0
    rows[QVEL] /= rows[QVEL].abs().amax(-1, keepdim=True)
    features, points = contact_features(scene, rows), scene.contacts
    times = features[CONTACT_DEPTH].shape[-1]
    for index in range(ROWS):
        gate = mujoco_contacts(scene, rows[index])[0] - points.margins
        gate = np.clip(gate / (FADE * (points.radii - points.margins)), 0.0, 1.0)
        for number in range(times):
            later, qpos = rows[index].clone(), rows[QPOS][index].numpy().copy()
            time = scene.control_step * number / times
            mujoco.mj_integratePos(scene.model, qpos, rows[QVEL][index].numpy(), time)
            later[QPOS] = torch.from_numpy(qpos)
            distance = mujoco_contacts(scene, later)[0]
            want = gate * np.maximum(points.radii - distance, 0.0)
            got = features[CONTACT_DEPTH][index, :, number]
            np.testing.assert_allclose(got, want, 0.0, 1e-5)
            predicted += (want > 0.0).sum()
    assert predicted > 0


@touching_scene
@pytest.mark.parametrize("where", ["margin", "fade", "touching"])
def test_features_have_no_jumps(scene, where, generator):
    if not is_raisable(scene):
        scene = HANDMADE["floater"]  # nothing of that scene can be raised
    rows, points = random_transitions(scene, ROWS, generator), scene.contacts
    chosen = torch.randint(len(points), (ROWS,), generator=generator)
    place = {
        "margin": points.margins,
        "fade": points.margins + FADE * (points.radii - points.margins),
        "touching": points.radii,
    }[where]
    here = [
        mujoco_contacts(scene, row)[0][i] for row, i in zip(rows, chosen, strict=True)
    ]
    height = torch.from_numpy(place)[chosen] - torch.tensor(here)
    above, below = (
        contact_features(scene, raised(scene, rows, height + side * 1e-7))
        for side in (1, -1)
    )
    for key in above:
        torch.testing.assert_close(above[key], below[key], rtol=0.0, atol=1e-3)
        if where == "margin":
            assert not above[key][range(ROWS), chosen].any()
    moved = above[CONTACT_DISTANCE] - below[CONTACT_DISTANCE]
    assert moved.max() > 0.9e-7


@touching_scene
def test_far_from_the_ground_all_is_zero(scene, generator):
    if not is_raisable(scene):
        scene = moved_scene(scene, 0.0, torch.zeros(3))
        scene.model.geom_pos[scene.model.geom("floor").id] = 0.0, 0.0, -100.0
        rows = random_transitions(scene, ROWS, generator)
    else:
        rows = random_transitions(scene, ROWS, generator)
        rows = raised(scene, rows, torch.full((ROWS,), 100.0))
    for value in contact_features(scene, rows).values():
        assert not value.any()


@touching_scene
def test_points_in_another_order_are_features_in_that_order(scene, generator):
    rows = near_ground(scene, generator)
    order = torch.randperm(len(scene.contacts), generator=generator)
    got = contact_features(with_points_in_order(scene, order), rows)
    want = contact_features(scene, rows)
    for key, value in got.items():
        torch.testing.assert_close(value, want[key][:, order], rtol=0.0, atol=1e-12)


@touching_scene
@pytest.mark.parametrize("junk", [1e30, -1e30])
def test_what_far_points_do_is_not_seen(scene, junk, generator, monkeypatch):
    """Points beyond their margin may move as they like: they have no slot of their own."""
    rows, transform = near_ground(scene, generator), ContactFeatures(scene)
    given = rows[QPOS], rows[QVEL], rows.get(TERRAIN, None)
    features = transform.contact_features(*given)
    is_far = features[0] == 0.0
    assert is_far.any()
    true = transform.kinematics.forward

    def corrupted(qpos, qvel):
        places, velocity = true(qpos, qvel)
        velocity = velocity.clone()
        velocity[0, :, : transform.count][is_far] = junk  # (1, ROWS, P, 3)
        return places, velocity

    monkeypatch.setattr(transform.kinematics, "forward", corrupted)
    for got, want in zip(transform.contact_features(*given), features, strict=True):
        assert torch.equal(got, want)


# a place 4,000 km away has 1e-9 m for its last digit, of which the gate makes 1e-7 and more
@touching_scene
@pytest.mark.parametrize(("distance", "tolerance"), [(1.0, 1e-10), (1e6, 1e-6)])
def test_place_and_heading_are_not_features(scene, distance, tolerance, generator):
    rows = random_transitions(scene, ROWS, generator)
    yaw, *shift = torch.randn(4, dtype=torch.float64, generator=generator)
    shift = distance * torch.stack(shift)
    elsewhere = moved_scene(scene, float(yaw), shift)
    moved = moved_rows(scene, rows, float(yaw), shift)
    got, want = contact_features(elsewhere, moved), contact_features(scene, rows)
    torch.testing.assert_close(got, want, rtol=0.0, atol=tolerance)


@every_scene
def test_keys_widths_and_precision(scene, generator):
    rows, transform = random_transitions(scene, 8, generator), ContactFeatures(scene)
    out = transform(rows.clone().reshape(2, 4)).reshape(8)
    assert (out.select(*rows.keys(True, True)) == rows).all()
    assert set(out.keys()) == {*rows.keys(), *transform.out_keys}
    for key, size in transform.sizes.items():
        assert out[key].shape == (8, size) and out[key].dtype == torch.float32
        if key != CONTACT_FORCE:
            want = contact_features(scene, rows)[key].flatten(1).float()
            torch.testing.assert_close(out[key], want)
    assert bool(transform.out_keys) == bool(len(scene.contacts))


def test_the_next_states_features_are_over_the_same_ground(generator):
    """Which data hold once, beside the state before the step."""
    scene = load_scene("cube_slope")
    rows = random_transitions(scene, 8, generator)
    rows["next"] = TensorDict({k: rows[k].flip(0) for k in (QPOS, QVEL)}, [8])
    found, transform = ContactFeatures(scene)(rows.clone()), ContactFeatures(scene)
    after = transform(rows["next"].clone().set(TERRAIN, rows[TERRAIN]))
    for key in transform.out_keys:
        assert torch.equal(found["next", key], after[key])
    assert TERRAIN not in found["next"].keys()


def test_equal_features_mean_equal_motion_on_a_slope(generator):
    """A ball on a fixed slope, turned on the spot: downhill is elsewhere in its frame."""
    scene = make_scene("""<mujoco><worldbody>
      <geom name="floor" type="plane" size="0 0 1" quat="0.95 0.3 0 0"/>
      <body><freejoint/><geom size="0.1"/></body></worldbody></mujoco>""")
    rows = random_transitions(scene, 50, generator)
    normal = torch.from_numpy(scene.terrain.fixed_plane[:3])
    rows[QPOS][:, :3], rows[QVEL][:] = 0.099 * normal, 0.0
    turned = moved_rows(scene, rows, 1.0, torch.zeros(3))
    turned[QPOS][:, :3] = rows[QPOS][:, :3]
    seen, change = [], []
    for start in (rows, turned):
        step = mujoco_step(scene, start.exclude("next"), rows["next", "joint_torque"])
        after, now = step["next"], (start[QPOS], start[QVEL])
        features = contact_features(scene, start).values()
        own = RobotCentric(scene).state_features(*now)
        seen.append(torch.cat((own, *(x.flatten(1) for x in features)), -1))
        change.append(StateDelta(scene).delta(*now, after[QPOS], after[QVEL]))
    looks_same = (seen[0] - seen[1]).abs().amax(-1) < 1e-6
    moves_differently = (change[0] - change[1]).abs().amax(-1) > 1e-3
    assert not (looks_same & moves_differently).any()


def test_a_missing_ground_is_named(generator):
    scene = load_scene("double_pendulum")
    rows = random_transitions(scene, 2, generator).exclude(TERRAIN)
    with pytest.raises(KeyError) as error:
        ContactFeatures(scene)(rows)
    assert error.value.args[0].startswith("ContactFeatures needs ['terrain'], got")
