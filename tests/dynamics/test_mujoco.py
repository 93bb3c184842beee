"""The batched rollout is a plain loop of mj_step, one MjData per env."""

import copy
from collections.abc import Iterator

import mujoco
import numpy as np
import pytest
import torch
from dynamics_helpers import (
    each_with_motors,
    random_drive,
    roll,
    stand_on_feet,
    unequal_keys,
)
from tensordict import TensorDict
from torch import Generator, Tensor

from torchrl_nerd import load_scene
from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.scenes import Scene

ROWS, STEPS = 16, 8


def plain_loop(
    scene: Scene, start: TensorDict, torques: Tensor, plane: Tensor | None = None
) -> Iterator[mujoco.MjData]:
    """MuJoCo's own data of one env after each control step."""
    model = copy.copy(scene.model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = start["qpos"], start["qvel"]
    if plane is not None:
        normal, offset = plane[:3].numpy(), float(plane[3])
        data.mocap_pos[0] = normal * offset
        mujoco.mju_quatZ2Vec(data.mocap_quat[0], normal)
    for torque in torques:
        data.qfrc_applied[scene.actuated] = torque
        mujoco.mj_step(model, data, scene.substeps)
        yield data


def assert_is_plain_loop(scene: Scene, generator: Generator) -> None:
    """Bit for bit; up to the rounding of the ground's orientation where it varies."""
    start, torques, terrain = random_drive(scene, ROWS, STEPS, generator)
    path = roll(MujocoDynamics(scene), start, torques, terrain)
    path = torch.cat((path["qpos"], path["qvel"]), -1).numpy()
    for row in range(ROWS):
        plane = None if terrain is None else terrain[row]
        loop = plain_loop(scene, start[row], torques[:, row], plane)
        expected = np.array([np.concatenate((x.qpos, x.qvel)) for x in loop])
        atol = 0.0 if plane is None else 1e-12 * np.abs(expected).max()
        np.testing.assert_allclose(path[row], expected, rtol=0, atol=atol)


def test_rollout_is_a_plain_loop_of_mj_step(scene, generator):
    assert_is_plain_loop(scene, generator)


def test_one_substep_at_a_time_is_the_same_loop(scene, generator):
    fine = Scene(scene.name, scene.model, 1, scene.controller, scene.sampling)
    assert_is_plain_loop(fine, generator)


def test_sensors_feel_from_the_first_step_on(generator):
    scene = load_scene("dm_control/hopper-hop")
    start, torques, _ = random_drive(scene, 2, 3, generator)
    stand_on_feet(scene, start)
    engine, state = MujocoDynamics(scene, 1), start
    loop = plain_loop(scene, start[0], torques[:, 0])
    for torque, data in zip(torques, loop, strict=True):
        state = engine.step(state, torque)
        felt = state["sensordata"][0].numpy()
        np.testing.assert_array_equal(felt, data.sensordata)
        assert felt[-2:].any()  # toe and heel


@pytest.mark.parametrize("rows", [1, 3, 33])
def test_threads_do_not_change_a_bit(scene, rows, generator):
    drive = random_drive(scene, rows, STEPS, generator)
    paths = [roll(MujocoDynamics(scene, num_threads=n), *drive) for n in (1, 2, 3)]
    for path in paths[1:]:
        assert not unequal_keys(path, paths[0])


def test_the_scene_is_left_as_it_was(scene, generator):
    flags, qpos0 = int(scene.model.opt.disableflags), scene.model.qpos0.copy()
    roll(MujocoDynamics(scene), *random_drive(scene, ROWS, 1, generator))
    assert int(scene.model.opt.disableflags) == flags
    np.testing.assert_array_equal(scene.model.qpos0, qpos0)


def test_a_trajectory_in_one_call_is_its_steps(scene, generator):
    start, torques, terrain = random_drive(scene, ROWS, STEPS, generator)
    path = roll(MujocoDynamics(scene), start, torques, terrain)
    whole = MujocoDynamics(scene).rollout(start, torques.transpose(0, 1), terrain)
    for key in ("qpos", "qvel"):
        scale = float(path[key].abs().max())
        torch.testing.assert_close(whole[key], path[key], rtol=0, atol=1e-12 * scale)


@each_with_motors
def test_a_row_that_breaks_on_the_way_is_sound_until_then(scene, generator):
    start, torques, terrain = random_drive(scene, ROWS, STEPS, generator)
    torques = torques.transpose(0, 1).clone()
    clean = MujocoDynamics(scene).rollout(start, torques, terrain)
    torques[3, 4] = torch.nan
    broken = MujocoDynamics(scene).rollout(start, torques, terrain)
    others = torch.arange(ROWS) != 3
    for key in ("qpos", "qvel"):
        assert torch.equal(broken[key][others], clean[key][others])
        assert torch.equal(broken[key][3, :4], clean[key][3, :4])
        assert broken[key][3, 4:].isnan().all()


def test_numbers_that_do_not_fit_are_refused(scene, generator):
    start, torques, terrain = random_drive(scene, ROWS, STEPS, generator)
    torques = torques.transpose(0, 1)
    some = None if terrain is None else terrain[:1]
    with pytest.raises(ValueError, match="expected joint_torque of shape"):
        MujocoDynamics(scene).rollout(start[:1], torques, some)  # not for all envs
    with pytest.raises(ValueError, match="num_threads, a whole number of at least 1"):
        MujocoDynamics(scene, num_threads=0)


def test_no_rows_at_all_stay_none(scene, generator):
    start, torques, terrain = random_drive(scene, 2, 3, generator)
    start, torque = start[:0], torques.transpose(0, 1)[:0]
    terrain = None if terrain is None else terrain[:0]
    path = MujocoDynamics(scene).rollout(start, torque, terrain)
    assert path.batch_size == (0, 3) and path["qpos"].shape == (0, 3, scene.layout.nq)
    assert len(MujocoDynamics(scene).step(start, torque[:, 0], terrain)) == 0


def test_no_steps_lead_nowhere(scene, generator):
    start, torques, terrain = random_drive(scene, ROWS, 1, generator)
    dynamics = MujocoDynamics(scene, 1)
    path = dynamics.rollout(start, torques.transpose(0, 1)[:, :0], terrain)
    assert path.batch_size == (ROWS, 0) and path["qvel"].shape[2:] == (scene.model.nv,)
    fresh = MujocoDynamics(scene, 1)
    after, expected = (d.step(start, torques[0], terrain) for d in (dynamics, fresh))
    assert not unequal_keys(after, expected)
