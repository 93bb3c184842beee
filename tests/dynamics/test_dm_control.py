"""dm_control's own Physics, driven by hand, gives the same bits."""

import copy
import pickle

import mujoco
import numpy as np
import torch
from dm_control.mujoco import Physics, wrapper
from dynamics_helpers import random_drive, roll
from servo_helpers import servo_scene
from tensordict import TensorDict

from torchrl_nerd.dynamics import DMControlDynamics, MujocoDynamics

ROWS, STEPS = 8, 8


def test_rows_are_dm_control_physics_bit_for_bit(scene, generator):
    start, torques, terrain = random_drive(scene, ROWS, STEPS, generator)
    path = roll(DMControlDynamics(scene), start, torques, terrain)
    model = copy.copy(scene.model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
    for row in range(ROWS):
        physics = Physics.from_model(wrapper.MjModel(model))
        with physics.reset_context():
            physics.data.qpos[:] = start["qpos"][row]
            physics.data.qvel[:] = start["qvel"][row]
            if terrain is not None:
                pose = scene.terrain.mocap_pose(terrain[row]).numpy()
                physics.data.mocap_pos[0] = pose[:3]
                physics.data.mocap_quat[0] = pose[3:]
        for step in range(STEPS):
            physics.data.qfrc_applied[scene.actuated] = torques[step, row]
            physics.step(scene.substeps)
            np.testing.assert_array_equal(path["qpos"][row, step], physics.data.qpos)
            np.testing.assert_array_equal(path["qvel"][row, step], physics.data.qvel)


def test_dm_control_and_mujoco_agree(scene, generator):
    drive = random_drive(scene, ROWS, STEPS, generator)
    paths = [roll(make(scene), *drive) for make in (DMControlDynamics, MujocoDynamics)]
    scale = torch.cat([paths[1]["qpos"], paths[1]["qvel"]], -1).abs().max()
    for key in ("qpos", "qvel"):
        difference = (paths[0][key] - paths[1][key]).abs().max()
        assert difference <= 1e-12 * scale


def test_a_state_written_from_outside_is_where_a_row_goes_on(scene, generator):
    drive = random_drive(scene, ROWS, STEPS, generator)
    start, torques, terrain = random_drive(scene, ROWS, 1, generator)
    used, fresh = DMControlDynamics(scene), DMControlDynamics(scene)
    roll(used, *drive)
    for key in ("qpos", "qvel"):
        moved, expected = (roll(d, start, torques, terrain)[key] for d in (used, fresh))
        used.reset(start)
        fresh.reset(start)
        assert torch.equal(moved, expected)


def test_a_row_goes_on_from_its_history_and_in_a_copy(scene, generator):
    """A step that is taken back leaves no trace; a history can be restored again."""
    start, torques, terrain = random_drive(scene, ROWS, STEPS, generator)
    expected = roll(DMControlDynamics(scene), start, torques, terrain)
    dynamics, half, all_envs = (
        DMControlDynamics(scene),
        STEPS // 2,
        torch.ones(ROWS) > 0,
    )
    now = roll(dynamics, start, torques[:half], terrain)[:, -1]
    past, copied = dynamics.history(), pickle.loads(pickle.dumps(dynamics))
    for _ in range(2):
        roll(dynamics, now, -0.5 * torques[half:], terrain)
        dynamics.restore(past, all_envs)
    for other in (dynamics, copied):
        found = roll(other, now, torques[half:], terrain)
        for key in ("qpos", "qvel"):
            assert torch.equal(found[key], expected[key][:, half:])


def test_servos_know_their_speed_in_a_state_that_was_written(tmp_path, generator):
    scene = servo_scene(tmp_path)
    state, _ = scene.sample_initial(ROWS, generator)
    state = TensorDict(state, [ROWS])
    torque = torch.zeros(ROWS, len(scene.actuated), dtype=torch.float64)
    ctrl = torch.rand(ROWS, scene.model.nu, dtype=torch.float64, generator=generator)
    ends = []
    for dynamics in (DMControlDynamics(scene), MujocoDynamics(scene)):
        dynamics.reset(state)
        ends.append(dynamics.step(state, torque, None, ctrl))
    for key in ("qpos", "qvel"):
        scale = 1.0 + ends[1][key].abs().max()
        assert (ends[0][key] - ends[1][key]).abs().max() < 1e-9 * scale
