"""MuJoCo Warp is MuJoCo to float32's rounding; its rows are worlds of their own.

The first run on a machine compiles Warp's kernels, which takes minutes. All that every
dynamics promises is in test_conformance.py, marked slow for this one.
"""

import copy
from dataclasses import replace

import mujoco
import pytest
import torch
from dynamics_helpers import random_drive, stand_on_feet, unequal_keys
from servo_helpers import arm_scene
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from torchrl_nerd import load_scene, make_env
from torchrl_nerd.dynamics import MujocoDynamics, MujocoWarpDynamics
from torchrl_nerd.scenes.commands import drive
from torchrl_nerd.scenes.sampling import sample_commands

pytest.importorskip("mujoco_warp")

ROWS, STEPS = 4, 3
ROUNDING = 1e-4  # of the largest number: hundreds of float32's steps, over all substeps


def drive_on_ground(scene, generator, depth=0.005):
    """A random drive from starts so deep (m) in the ground, where there is one."""
    start, torques, terrain = random_drive(scene, ROWS, STEPS, generator)
    if terrain is None:
        scene.place_on_terrain(start, torch.full((ROWS,), -depth, dtype=torch.float64))
    else:
        terrain[:, 3] += scene.clearances(start["qpos"], terrain).amin(-1) + depth
    return start, torques, terrain


def assert_agree(got: TensorDict, expected: TensorDict) -> None:
    for key in expected.keys():
        limit = ROUNDING * (1.0 + expected[key].abs().max())
        assert (got[key] - expected[key]).abs().max() <= limit, key


@pytest.mark.parametrize("is_touching", [False, True])
def test_a_step_is_that_of_mujoco(scene, is_touching, generator):
    if is_touching:
        state, torques, terrain = drive_on_ground(scene, generator)
        gaps = scene.clearances(state["qpos"], terrain)
        assert (gaps < 0.0).any(-1).all() or not len(scene.contacts)
    else:
        state, torques, terrain = random_drive(scene, ROWS, STEPS, generator)
    ground_truth, warp = MujocoDynamics(scene, 1), MujocoWarpDynamics(scene, "cpu")
    for torque in torques:
        expected = ground_truth.step(state, torque, terrain)
        assert_agree(warp.step(state, torque, terrain), expected)
        state = expected


def test_sensors_feel_what_they_feel_in_mujoco(generator):
    scene = load_scene("dm_control/hopper-hop")
    state, torques, terrain = random_drive(scene, ROWS, STEPS, generator)
    stand_on_feet(scene, state)
    ground_truth, warp = MujocoDynamics(scene, 1), MujocoWarpDynamics(scene, "cpu")
    for torque in torques:
        expected = ground_truth.step(state, torque, terrain)
        assert_agree(warp.step(state, torque, terrain), expected)
        state = expected
        assert (expected["sensordata"][:, -2:] > 0.0).any()  # of toe and heel


@pytest.mark.slow
def test_servos_and_held_torques_are_those_of_mujoco(tmp_path, generator):
    """Damped joints and an implicit integrator, with and without actuators."""
    scene = arm_scene(tmp_path)
    start = TensorDict(scene.sample_initial(ROWS, generator)[0], [ROWS])
    command = sample_commands(scene.sampling, torch.ones(ROWS, 1), 1, generator)[:, 0]
    torque, ctrl = drive(scene, command, start["qpos"], start["qvel"])
    ground_truth, warp = MujocoDynamics(scene, 1), MujocoWarpDynamics(scene, "cpu")
    for told in (ctrl, None, ctrl):
        for dynamics in (ground_truth, warp):
            dynamics.reset(start)
        expected = ground_truth.step(start, torque, None, told)
        assert_agree(warp.step(start, torque, None, told), expected)


def test_broken_rows_break_no_other_and_heal(generator):
    scene = load_scene("double_pendulum")
    state, torques, terrain = drive_on_ground(scene, generator)
    clean = MujocoWarpDynamics(scene, "cpu").step(state, torques[0], terrain)
    broken, torque = state.clone(), torques[0].clone()
    broken["qpos"][0], broken["qvel"][1], torque[2] = torch.nan, 1e30, torch.inf
    warp = MujocoWarpDynamics(scene, "cpu")
    after = warp.step(broken, torque, terrain)
    assert not unequal_keys(after[3:], clean[3:])
    assert torch.cat((after["qpos"], after["qvel"]), -1)[:3].isnan().all()
    warp.reset(state)
    assert not unequal_keys(warp.step(state, torques[0], terrain), clean)


def test_contacts_that_have_no_room_are_not_lost_in_silence(generator):
    scene = load_scene("ant")
    state, torques, terrain = drive_on_ground(scene, generator, depth=0.3)
    expected = MujocoDynamics(scene, 1).step(state, torques[0], terrain)
    little = MujocoWarpDynamics(scene, "cpu", max_contacts=1)
    after = little.step(state, torques[0], terrain)
    assert after["qpos"].isnan().any()
    rows = after["qpos"].isfinite().all(-1)
    if rows.any():
        assert_agree(after[rows], expected[rows])


def test_an_env_moves_as_it_does_in_mujoco(generator):
    envs = [
        make_env("cartpole/swingup", dynamics=name, num_envs=ROWS, seed=3)
        for name in ("mujoco", "mujoco_warp")
    ]
    check_env_specs(envs[1])
    action = 2.0 * torch.rand(ROWS, 1, generator=generator) - 1.0
    paths = []
    for env in envs:
        env.set_seed(3)
        env.reset()
        td = TensorDict({"action": action}, [ROWS])
        paths.append(env.step(td)["next"].select("qpos", "qvel", "reward"))
    assert_agree(paths[1], paths[0])


def test_what_it_cannot_do_is_refused_in_a_sentence():
    scene = load_scene("cartpole")
    model = copy.copy(scene.model)
    model.opt.solver = mujoco.mjtSolver.mjSOL_PGS
    with pytest.raises(ValueError, match="cannot step scene 'cartpole': mjSOL_PGS"):
        MujocoWarpDynamics(replace(scene, model=model), "cpu")
    with pytest.raises(ValueError, match="no device 'meta'"):
        MujocoWarpDynamics(scene, "meta")


@pytest.mark.gpu
@pytest.mark.parametrize("is_capturing", [True, False])
def test_a_gpu_steps_as_mujoco_does(scene, is_capturing, generator):
    state, torques, terrain = random_drive(scene, 64, 5, generator)
    ground_truth = MujocoDynamics(scene)
    warp = MujocoWarpDynamics(scene, "cuda", is_capturing=is_capturing)
    for torque in torques:
        expected = ground_truth.step(state, torque, terrain)
        ground = None if terrain is None else terrain.cuda()
        after = warp.step(state.to("cuda"), torque.cuda(), ground)
        assert after.device is not None and after.device.type == "cuda"
        assert_agree(after.cpu(), expected)
        state = expected
