"""Points on random robots and on every scene against mj_kinematics and mj_jac."""

import mujoco
import numpy as np
import pytest
import torch
from helpers import every_scene, random_quats, random_states, random_tree

from torchrl_nerd.geometry.base import Base, root_pose
from torchrl_nerd.geometry.kinematics import PointKinematics
from torchrl_nerd.geometry.rotations import matrix_from_quat

ROWS, POINTS = 20, 7


def random_points(model, base, rng):
    """Bodies that move, the base itself and props included, and places on them."""
    carried = {base.body, *np.flatnonzero(model.body_treeid >= 0).tolist()}
    return rng.choice(sorted(carried), POINTS).tolist(), rng.normal(size=(POINTS, 3))


def seen_by_the_base(model, base, mount, data, body, point):
    """Position and velocity of one point by MuJoCo, to a rider on the base, in B_t."""
    world = data.xpos[body] + data.xmat[body].reshape(3, 3) @ point
    jacobian, velocity, turning = np.empty((3, model.nv)), np.zeros(3), np.zeros(3)
    mujoco.mj_jac(model, data, jacobian, None, world, body)
    if base.is_floating:
        position = data.xpos[base.body]
        rotation = data.xmat[base.body].reshape(3, 3)
        v = base.dof_address
        velocity = data.qvel[v : v + 3]
        turning = rotation @ data.qvel[v + 3 : v + 6]
    else:
        position, rotation = mount
    arm = world - position
    relative = jacobian @ data.qvel - velocity - np.cross(turning, arm)
    return rotation.T @ arm, rotation.T @ relative


def check_against_mujoco(model, rng):
    base, data = Base.from_model(model), mujoco.MjData(model)
    mount = root_pose(model, base.body)
    bodies, places = random_points(model, base, rng)
    qpos, qvel = random_states(model, ROWS, rng)
    positions, velocities = PointKinematics(model, base, bodies, places)(qpos, qvel)
    assert positions.shape == velocities.shape == (ROWS, POINTS, 3)
    for row in range(ROWS):
        data.qpos, data.qvel = qpos[row].numpy(), qvel[row].numpy()
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        for point, (body, place) in enumerate(zip(bodies, places, strict=True)):
            where, speed = seen_by_the_base(model, base, mount, data, body, place)
            np.testing.assert_allclose(positions[row, point], where, 0, 1e-11)
            np.testing.assert_allclose(velocities[row, point], speed, 0, 1e-10)


@pytest.mark.parametrize("is_floating", [True, False], ids=["floating", "fixed"])
@pytest.mark.parametrize("draw", range(4))
def test_random_robots_move_as_in_mujoco(is_floating, draw, rng):
    check_against_mujoco(random_tree(rng, is_floating), rng)


@every_scene
def test_scenes_move_as_in_mujoco(scene, rng):
    check_against_mujoco(scene.model, rng)


def test_distance_from_the_origin_costs_no_digits(rng):
    model = random_tree(rng, is_floating=True)
    base = Base.from_model(model)
    kinematics = PointKinematics(model, base, *random_points(model, base, rng))
    qpos, qvel = random_states(model, ROWS, rng)
    far = qpos.clone()
    far[:, :3] += 1e6 * torch.from_numpy(rng.normal(size=3))
    for here, there in zip(kinematics(qpos, qvel), kinematics(far, qvel), strict=True):
        assert torch.equal(here, there)


def test_velocities_are_the_derivative_of_positions(rng):
    model = random_tree(rng, is_floating=False)
    base = Base.from_model(model)
    kinematics = PointKinematics(model, base, *random_points(model, base, rng))
    qpos, qvel = random_states(model, ROWS, rng)
    step, moved = 1e-6, []
    for sign in (-1.0, 1.0):
        there = qpos.numpy().copy()
        for q, v in zip(there, qvel.numpy(), strict=True):
            mujoco.mj_integratePos(model, q, v, sign * step)
        moved.append(kinematics(torch.from_numpy(there), qvel)[0])
    slope = (moved[1] - moved[0]) / (2.0 * step)
    torch.testing.assert_close(slope, kinematics(qpos, qvel)[1], rtol=1e-6, atol=1e-6)


def test_leading_dimensions_are_kept(rng):
    model = random_tree(rng, is_floating=True)
    base = Base.from_model(model)
    kinematics = PointKinematics(model, base, *random_points(model, base, rng))
    qpos, qvel = random_states(model, 6, rng)
    flat = kinematics(qpos, qvel)
    batch = kinematics(qpos.reshape(2, 3, -1), qvel.reshape(2, 3, -1))
    one = kinematics(qpos[4], qvel[4])
    for x, y, z in zip(flat, batch, one, strict=True):
        torch.testing.assert_close(y.reshape(6, POINTS, 3), x, rtol=0.0, atol=1e-14)
        torch.testing.assert_close(z, x[4], rtol=0.0, atol=1e-14)


def test_matrices_are_mujocos(generator):
    for quat in random_quats(50, generator):
        want = np.empty(9)
        mujoco.mju_quat2Mat(want, quat.numpy())
        got = matrix_from_quat(quat).reshape(9)
        np.testing.assert_allclose(got, want, 0, 1e-15)


def test_the_robot_is_the_tree_with_the_actuators():
    free = '<body name="{0}"><freejoint/><geom size="1"/>{1}</body>'
    arm = '<body name="{0}arm"><joint name="{0}"/><geom size="1"/></body>'
    trees = free.format("ball", "") + free.format("robot", arm.format("a"))
    for motors, name in (("", "ball"), ('<motor joint="a"/>', "robot")):
        model = mujoco.MjModel.from_xml_string(
            f"<mujoco><worldbody>{trees}</worldbody><actuator>{motors}</actuator></mujoco>"
        )
        base = Base.from_model(model)
        assert base.is_floating and model.body(base.body).name == name
        assert len(base.others) == 1 and base.qpos_address == 7 * bool(motors)
    bare = '<mujoco><worldbody><body><geom size="1"/></body></worldbody></mujoco>'
    with pytest.raises(ValueError, match="no joint"):
        Base.from_model(mujoco.MjModel.from_xml_string(bare))


def test_points_must_be_on_the_robot(rng):
    model = random_tree(rng, is_floating=False)
    base = Base.from_model(model)
    assert model.body_parentid[base.body] == 1  # body 1 is fixed in the world
    with pytest.raises(ValueError, match="moving bodies of the robot"):
        PointKinematics(model, base, [1], np.zeros((1, 3)))


@pytest.mark.parametrize("is_floating", [True, False])
@pytest.mark.parametrize("moving", [0, 1, 3])
def test_the_first_positions_alone_may_have_velocities(is_floating, moving, rng):
    model = random_tree(rng, is_floating)
    base = Base.from_model(model)
    kinematics = PointKinematics(model, base, *random_points(model, base, rng))
    qpos, qvel = random_states(model, 5, rng)
    positions, velocities = kinematics(qpos, qvel)
    same, first = kinematics(qpos, qvel[:moving])
    torch.testing.assert_close(same, positions, rtol=0, atol=1e-12)
    torch.testing.assert_close(first, velocities[:moving], rtol=0, atol=1e-11)
