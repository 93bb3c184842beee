"""The robot's own features: blind to place and heading, exact in everything else."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
from helpers import (
    HANDMADE,
    every_scene,
    moved_rows,
    moved_scene,
    random_transitions,
)
from tensordict import TensorDict

from torchrl_nerd.geometry.manifold import HINGE
from torchrl_nerd.keys import QPOS, QVEL, ROBOT_STATE, ROBOT_TORQUE
from torchrl_nerd.robots import load_scene
from torchrl_nerd.transforms import RobotCentric

ROWS = 50


def state_features(scene, rows):
    return RobotCentric(scene).state_features(rows[QPOS], rows[QVEL])


@every_scene
@pytest.mark.parametrize("distance", [1.0, 1e6])
def test_place_and_heading_are_not_features(scene, distance, generator):
    rows = random_transitions(scene, ROWS, generator)
    yaw, *shift = torch.randn(4, dtype=torch.float64, generator=generator)
    shift = distance * torch.stack(shift)
    elsewhere = moved_scene(scene, float(yaw), shift)
    moved = moved_rows(scene, rows, float(yaw), shift)
    got, want = state_features(elsewhere, moved), state_features(scene, rows)
    # a prop is as near to the base as numbers of that size can tell
    rounding = 1e-15 * distance * bool(scene.base.others)
    torch.testing.assert_close(got, want, rtol=0.0, atol=1e-10 + rounding)


@every_scene
def test_keys_widths_and_precision(scene, generator):
    rows, transform = random_transitions(scene, ROWS, generator), RobotCentric(scene)
    before = rows.clone()
    out = transform(rows)
    assert set(out.keys()) == {*before.keys(), *transform.sizes}
    for key, size in transform.sizes.items():
        assert out[key].shape == (ROWS, size) and out[key].dtype == torch.float32
    assert transform.sizes.get(ROBOT_TORQUE, 0) == len(scene.actuated)
    assert (out.select(*before.keys(True, True)) == before).all()
    want = state_features(scene, before)
    assert want.dtype == torch.float64
    assert torch.equal(out[ROBOT_STATE], want.float())


@every_scene
def test_leading_dimensions_are_kept(scene, generator):
    rows, transform = random_transitions(scene, 6, generator), RobotCentric(scene)
    flat, batch = transform(rows.clone()), transform(rows.clone().reshape(2, 3))
    assert (batch.reshape(6) == flat).all()


def test_torques_come_with_the_transition(scene, generator):
    rows, transform = random_transitions(scene, ROWS, generator), RobotCentric(scene)
    torque, moved = rows["next", "joint_torque"], transform(rows.clone())
    assert (ROBOT_TORQUE in moved.keys()) == bool(scene.actuated)
    if scene.actuated:
        assert torch.equal(moved[ROBOT_TORQUE], torque.float())
    root = transform(rows.exclude("next"))
    assert ROBOT_TORQUE not in root.keys() and ROBOT_STATE in root.keys()


@every_scene
def test_a_full_turn_of_a_free_hinge_changes_nothing(scene, generator):
    rows, model = random_transitions(scene, ROWS, generator), scene.model
    turned = rows.clone()
    for joint in range(model.njnt):
        if model.jnt_type[joint] == HINGE and not model.jnt_limited[joint]:
            turns = torch.randint(-5, 6, (ROWS,), generator=generator).double()
            turned[QPOS][:, model.jnt_qposadr[joint]] += 2.0 * torch.pi * turns
    for q, _ in scene.layout.rotations:  # and a quaternion's sign is no feature
        turned[QPOS][:, q : q + 4] *= -1.0
    got, want = state_features(scene, turned), state_features(scene, rows)
    torch.testing.assert_close(got, want, rtol=0.0, atol=1e-12)


def test_cartpole_sees_its_place_only_near_the_rails_ends(generator):
    scene = load_scene("cartpole")
    margin = 1.5 * 10.0 / 60.0  # m: a step and a half at top speed
    rows = random_transitions(scene, ROWS, generator)
    u = torch.rand(3, ROWS, dtype=torch.float64, generator=generator)
    middle, elsewhere, near = rows.clone(), rows.clone(), rows.clone()
    middle[QPOS][:, 0] = (4.0 - margin) * (2.0 * u[0] - 1.0)
    elsewhere[QPOS][:, 0] = (4.0 - margin) * (2.0 * u[1] - 1.0)
    elsewhere[QVEL][:, 0] = 20.0 * u[2] - 10.0
    assert torch.equal(state_features(scene, middle), state_features(scene, elsewhere))
    near[QPOS][:, 0] = 4.0 - 0.99 * margin * u[0]
    difference = state_features(scene, near) - state_features(scene, middle)
    assert (difference.abs().amax(-1) > 1e-4).all()


def test_cartpoles_features_are_the_closed_form(generator):
    scene, margin = load_scene("cartpole"), 0.25
    rows = random_transitions(scene, ROWS, generator)
    rows[QPOS][:, 0] *= 1.3  # beyond the rail's ends too
    (x, angle), (speed, spin) = rows[QPOS].T, rows[QVEL].T
    below, above = (x + 4.0 - margin).clamp_max(0), (4.0 - margin - x).clamp_max(0)
    gate = (-torch.minimum(below, above) / (0.25 * margin)).clamp(0.0, 1.0)
    want = torch.stack((angle.sin(), angle.cos(), spin, below, above, gate * speed), -1)
    torch.testing.assert_close(state_features(scene, rows), want, rtol=0.0, atol=1e-12)
    assert (gate > 0.0).any() and (gate < 1.0).any()


def test_a_floating_base_feels_its_velocity_and_gravity(generator):
    scene = HANDMADE["floater"]
    rows = random_transitions(scene, ROWS, generator)
    data, velocity = mujoco.MjData(scene.model), np.zeros(6)
    kind = mujoco.mjtObj.mjOBJ_XBODY
    features = state_features(scene, rows)
    for row, got in zip(rows, features, strict=True):
        data.qpos, data.qvel = row[QPOS].numpy(), row[QVEL].numpy()
        mujoco.mj_forward(scene.model, data)
        body = scene.base.body
        mujoco.mj_objectVelocity(scene.model, data, kind, body, velocity, 1)
        down = data.xmat[body].reshape(3, 3).T @ (0.0, 0.0, -1.0)
        want = np.concatenate((velocity[3:], velocity[:3], down))
        np.testing.assert_allclose(got[:9], want, 0.0, 1e-12)


@pytest.mark.parametrize("name", HANDMADE)
def test_a_ball_is_its_rotation_matrix(name, generator):
    scene = HANDMADE[name]
    joint = list(scene.model.jnt_type).index(mujoco.mjtJoint.mjJNT_BALL)
    address = scene.model.jnt_qposadr[joint]
    rows = random_transitions(scene, ROWS, generator)
    for row, features in zip(rows, state_features(scene, rows), strict=True):
        matrix = np.empty(9)
        mujoco.mju_quat2Mat(matrix, row[QPOS][address : address + 4].numpy())
        columns = torch.from_numpy(matrix.reshape(3, 3)[:, :2].flatten())
        windows = features.unfold(0, 6, 1)
        assert (windows - columns).abs().amax(-1).min() < 1e-12


@pytest.mark.parametrize("key", [QPOS, QVEL])
def test_a_missing_state_is_named(scene, key, generator):
    rows = random_transitions(scene, 2, generator).exclude(key)
    with pytest.raises(KeyError) as error:
        RobotCentric(scene)(rows)
    assert error.value.args[0].startswith(f"RobotCentric needs ['{key}'], got")


def test_the_empty_batch_passes(scene):
    nq, nv = scene.model.nq, scene.model.nv
    rows = TensorDict({QPOS: torch.zeros(0, nq), QVEL: torch.zeros(0, nv)}, [0])
    transform = RobotCentric(scene)
    assert transform(rows)[ROBOT_STATE].shape == (0, transform.sizes[ROBOT_STATE])


def test_the_next_state_has_features_too_where_it_is_recorded(generator):
    """As an off-policy loss needs them of a buffer's samples."""
    scene = load_scene("cartpole")
    rows, transform = random_transitions(scene, ROWS, generator), RobotCentric(scene)
    after = transform(rows.clone())["next"]
    expected = transform(rows["next"].select(QPOS, QVEL))
    torch.testing.assert_close(after[ROBOT_STATE], expected[ROBOT_STATE])


def test_joints_that_begin_at_rest_have_finite_features(generator):
    scene = load_scene("cartpole")
    rows = random_transitions(scene, 8, generator)
    still = replace(scene.sampling, qvel_low=(0.0, 0.0), qvel_high=(0.0, 0.0))
    features = RobotCentric(replace(scene, sampling=still))(rows)
    assert features[ROBOT_STATE].isfinite().all()


def test_states_of_another_robot_are_refused():
    """Whose joints would be read as if they were its own."""
    state = {QPOS: torch.zeros(3, 15).double(), QVEL: torch.zeros(3, 14).double()}
    with pytest.raises(ValueError, match="'cartpole' expects qpos of width 2, got 15"):
        RobotCentric(load_scene("cartpole"))(TensorDict(state, [3]))
