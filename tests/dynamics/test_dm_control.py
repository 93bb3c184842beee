"""dm_control's own Physics, driven by hand, gives the same bits."""

import copy

import mujoco
import numpy as np
import torch
from dm_control.mujoco import Physics, wrapper
from dynamics_helpers import random_drive, roll

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


def test_a_history_that_was_restored_stays_as_it_was(scene, generator):
    start, torques, terrain = random_drive(scene, ROWS, STEPS, generator)
    dynamics = DMControlDynamics(scene)
    after = roll(dynamics, start, torques, terrain)[:, -1]
    past = dynamics.history()
    kept = np.stack([physics.data.qpos for physics in past])
    dynamics.restore(past, torch.ones(ROWS, dtype=torch.bool))
    dynamics.step(after, torques[0], terrain)
    np.testing.assert_array_equal([physics.data.qpos for physics in past], kept)
