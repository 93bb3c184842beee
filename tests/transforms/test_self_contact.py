"""What a model sees of a robot's contacts with itself, against MuJoCo's kinematics."""

import mujoco
import pytest
import torch
from helpers import moved_rows
from tensordict import TensorDict

from torchrl_nerd.configs import NO_PREDICTIONS, FeatureConfig
from torchrl_nerd.geometry.manifold import integrate_pos
from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.modules.nerd import SceneFeatures
from torchrl_nerd.robots import SCENES, load_scene
from torchrl_nerd.scenes.self_contacts import capsule_pairs
from torchrl_nerd.transforms import ContactFeatures, SelfContactFeatures
from torchrl_nerd.transforms.predicted_contact import times_of

ROWS, TINY = 60, 1e-7
ON = FeatureConfig(self_contact=True)
NAMES = ("dm_control/hopper-hop", "dm_control/humanoid-run", "gymnasium/Humanoid-v5")
each_robot = pytest.mark.parametrize("name", NAMES)


def states(scene, generator):
    values, _ = scene.sample_initial(ROWS, generator)
    return TensorDict(values, [ROWS])


def parts(scene, rows):
    """Distance beyond the margin ``(rows, P)``, normal, speed, sliding and depths."""
    transform = SelfContactFeatures(scene, ON)
    (value,) = transform.self_contact_features(rows[QPOS], rows[QVEL])
    count = len(capsule_pairs(scene.model))
    beyond, gated = value.split((count, value.shape[-1] - count), -1)
    widths = (3, 1, 3, len(times_of(scene)))
    return beyond, *gated.unflatten(-1, (count, -1)).split(widths, -1)


def mujoco_distances(scene, qpos):
    """Of every pair, and the way from first to second in B_t, ``(rows, P)``, m."""
    model, data = scene.model, mujoco.MjData(scene.model)
    pairs, distances, ways = capsule_pairs(model).geoms.tolist(), [], []
    for place in qpos:
        data.qpos[:] = place
        mujoco.mj_kinematics(model, data)
        for first, second in pairs:
            way = torch.zeros(6, dtype=torch.float64)
            found = mujoco.mj_geomDistance(model, data, first, second, 9.0, way.numpy())
            distances.append(found)
            turn = torch.from_numpy(data.xmat[scene.base.body].reshape(3, 3).copy())
            ways.append((way[3:] - way[:3]) @ turn)
    found = torch.tensor(distances, dtype=torch.float64).view(len(qpos), -1)
    return found, torch.stack(ways).view(*found.shape, 3)


@each_robot
def test_distances_and_normals_are_mujocos(name, generator):
    scene = load_scene(name)
    rows, margins = states(scene, generator), capsule_pairs(scene.model).margins
    beyond, normal, *_ = parts(scene, rows)
    distance, way = mujoco_distances(scene, rows[QPOS])
    want = (distance - torch.from_numpy(margins)).clamp_max(0.0)
    torch.testing.assert_close(beyond, want, rtol=0.0, atol=1e-9)
    near = (distance < 0.7 * torch.from_numpy(margins)) & (distance > 1e-3)
    assert near.any()
    if scene.base.is_floating:
        want = torch.nn.functional.normalize(way, dim=-1)[near]
        torch.testing.assert_close(normal[near], want, rtol=0.0, atol=1e-6)


@each_robot
def test_speeds_are_rates_of_the_distances_and_depths_begin_with_todays(
    name, generator
):
    scene = load_scene(name)
    rows, margins = states(scene, generator), capsule_pairs(scene.model).margins
    beyond, normal, speed, sliding, depth = parts(scene, rows)
    inside = beyond < -0.3 * torch.from_numpy(margins)  # the gate is 1
    later, sooner = (
        mujoco_distances(
            scene, integrate_pos(scene.layout, rows[QPOS], dt * rows[QVEL])
        )[0]
        for dt in (TINY, -TINY)
    )
    rate = (later - sooner) / (2.0 * TINY)
    torch.testing.assert_close(
        speed[..., 0][inside], rate[inside], rtol=1e-4, atol=1e-4
    )
    assert (sliding * normal).sum(-1).abs().max() < 1e-9
    now = -(beyond + torch.from_numpy(margins))
    torch.testing.assert_close(depth[..., 0][inside], now.clamp_min(0.0)[inside])


@each_robot
def test_features_do_not_change_with_place_and_heading(name, generator):
    scene = load_scene(name)
    rows = states(scene, generator)
    features = SelfContactFeatures(scene, ON)
    here = features.self_contact_features(rows[QPOS], rows[QVEL])
    assert here[0].shape == (ROWS, *features.sizes.values())
    if scene.base.is_floating:
        moved = moved_rows(scene, rows, 1.1, torch.tensor([30.0, -4.0, 2.0]).double())
        there = features.self_contact_features(moved[QPOS], moved[QVEL])
        torch.testing.assert_close(here, there, rtol=0.0, atol=1e-9)


@each_robot
def test_features_fade_to_zero_at_the_margin(name, generator):
    """Beyond the margin all are zero, and just inside it they are nearly so."""
    scene = load_scene(name)
    rows = states(scene, generator)
    far, *gated = parts(scene, rows)
    beyond = far == 0.0
    assert beyond.any() and all((part[beyond] == 0.0).all() for part in gated)
    barely = (far < 0.0) & (far > -1e-3 * capsule_pairs(scene.model).margins.min())
    for part in gated:
        assert (part[barely].abs() <= 5e-3 * (1.0 + part.abs().max())).all()


def test_they_are_there_only_where_asked_for_and_where_shapes_can_touch():
    names = [*SCENES, *NAMES, "gymnasium/Ant-v5", "dm_control/walker-walk"]
    for scene in map(load_scene, names):
        plain = SceneFeatures(scene)
        assert plain.config == NO_PREDICTIONS and not plain.own.sizes
        more = SceneFeatures(scene, ON).size - plain.size
        assert (more > 0) == (scene.name in NAMES)


def test_the_transform_writes_its_key(generator):
    scene = load_scene(NAMES[0])
    rows = states(scene, generator)
    transform = SelfContactFeatures(scene, ON)
    value = transform(rows.clone())["self_contact"]
    (want,) = transform.self_contact_features(rows[QPOS], rows[QVEL])
    torch.testing.assert_close(value, want.float())


@pytest.mark.parametrize("kind", [ContactFeatures, SelfContactFeatures])
def test_a_robot_without_contacts_needs_no_state(kind):
    transform = kind(load_scene("cartpole"), ON)
    assert not transform.in_keys and not transform.out_keys
    assert transform(TensorDict(action=torch.zeros(ROWS, 1))).keys() == {"action"}
