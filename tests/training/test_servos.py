"""Robots with servos: data, training, inference and logs carry their controls."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from dynamics_helpers import enliven, random_model
from helpers import simulated
from servo_helpers import ENGINE_ALONE, arm_scene, servo_scene
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from torchrl_nerd.checkpoint import load_checkpoint
from torchrl_nerd.configs import NO_PREDICTIONS, DataConfig, FinetuneConfig, TrainConfig
from torchrl_nerd.data import generate as generate_module
from torchrl_nerd.data.generate import generate, load_data
from torchrl_nerd.data.log_files import load_recording, read_log
from torchrl_nerd.data.store import chunk_path, read_chunk, write_chunk
from torchrl_nerd.data.strategies import strategy
from torchrl_nerd.dynamics import MujocoDynamics, NeRDDynamics
from torchrl_nerd.envs import NeRDEnv
from torchrl_nerd.evaluation.bench.candidates import NoMotion
from torchrl_nerd.evaluation.rollout_error import passive_errors
from torchrl_nerd.keys import CTRL, JOINT_TORQUE, QPOS, QVEL
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.modules.networks import network_config
from torchrl_nerd.scenes.commands import actuate, drive, drive_of
from torchrl_nerd.scenes.controllers import TorqueController
from torchrl_nerd.tasks import SceneTask
from torchrl_nerd.training.finetune import FineTuner
from torchrl_nerd.training.policy_data import policy_data
from torchrl_nerd.training.samples import cover, data_stats
from torchrl_nerd.training.trainer import Trainer

BRIEF = TrainConfig(
    network="mlp-4x64",
    steps=200,
    rollout_steps=5,
    batch_size=128,
    sequence_length=2,
    rollout_batch_size=16,
    rollout_length=4,
    warmup=20,
    save_every=1000,
    validate_every=1000,
)


@pytest.fixture
def arm(tmp_path):
    """Two links held by stiff servos."""
    return arm_scene(tmp_path)


def one_step(scene):
    """A state in mid range, its torque and its controls, for `Dynamics.step`."""
    qpos = torch.zeros(2, scene.model.nq).double()
    ctrl = torch.ones(2, scene.model.nu).double()
    torque = scene.servos.torque(ctrl, qpos, qpos)
    return TensorDict({QPOS: qpos, QVEL: qpos}, [2]), torque, None, ctrl


def test_a_data_set_holds_controls_and_is_finished_to_the_same_bits(
    arm, tmp_path, monkeypatch
):
    monkeypatch.setattr(generate_module, "CHUNK", 4)
    config = DataConfig(trajectories=10, steps=20, seed=3)
    whole = load_data(arm, generate(arm, config, tmp_path / "whole", quiet=True))
    ctrl, torque = whole[CTRL], whole["next", "joint_torque"]
    assert ctrl.shape == (10, 20, 2) and (ctrl.abs() <= 2.0).all()
    assert torch.equal(torque, arm.servos.torque(ctrl, whole[QPOS], whole[QVEL]))
    folder, original = tmp_path / "cut", generate_module.write_chunk

    def killed(data, path):
        if path.name.endswith("1.safetensors"):
            raise KeyboardInterrupt
        original(data, path)

    monkeypatch.setattr(generate_module, "write_chunk", killed)
    with pytest.raises(KeyboardInterrupt):
        generate(arm, config, folder, quiet=True)
    monkeypatch.setattr(generate_module, "write_chunk", original)
    again = load_data(arm, generate(arm, config, folder, quiet=True))
    for key in whole.keys(True, True):
        assert torch.equal(whole[key], again[key])


def test_data_without_controls_are_refused_in_one_sentence(arm, tmp_path):
    folder = generate(arm, DataConfig(trajectories=3, steps=4), tmp_path / "d", True)
    path = chunk_path(folder, 0)
    data = read_chunk(path, 2).clone()
    for damaged in (data.exclude(CTRL), data.clone().set(CTRL, data[CTRL][..., :1])):
        write_chunk(damaged, path)
        with pytest.raises(
            ValueError, match=r"'next/ctrl' of shape \(3, 4, 2\)"
        ) as error:
            load_data(arm, folder)
        assert "\n" not in str(error.value)


def test_resting_states_are_held_by_the_servos(arm, generator):
    data = strategy(arm, "resting")(12, 4, generator)
    assert data[CTRL].shape == (12, 4, 2) and data[QVEL].isfinite().all()


def test_a_trained_model_follows_the_servos(arm, tmp_path):
    """Seconds of training beat no motion, under controls that training did not see."""
    data = load_data(arm, generate(arm, DataConfig(512, 20), tmp_path / "data", True))
    how = {"horizons": (5, 10), "quiet": True, "random_actions": True}
    trainer = Trainer(arm, data, SceneTask(arm), BRIEF, tmp_path / "run", **how)
    model = trainer.run()
    errors = []
    for dynamics in (NeRDDynamics(model), NoMotion(arm)):
        case = arm, dynamics, MujocoDynamics(arm), [10], 64, 500
        found = passive_errors(*case, random_actions=True)
        errors.append(sum(x.mean for x in found[10].values()))
    assert errors[0] < 0.5 * errors[1]
    loaded = load_checkpoint(tmp_path / "run" / "last", arm)
    here, there = (NeRDDynamics(m).step(*one_step(arm)) for m in (model, loaded))
    assert torch.equal(here[QPOS], there[QPOS])


def test_controls_are_features_that_the_model_uses(tmp_path, generator):
    """At equal state and torque another control leads elsewhere; motors have no feature."""
    scene = servo_scene(tmp_path, more=ENGINE_ALONE)
    model = random_model(scene, generator)
    enliven(model.network, generator)
    sizes = model.scene_features.robot.sizes
    assert sizes["robot_ctrl"] == 16 and sizes["robot_torque"] == 6
    data = simulated(scene, generator, 4, 3).transitions()
    torque = data["next", "joint_torque"]
    tokens = model.scene_features(
        data[QPOS], data[QVEL], drive_of(torque, data[CTRL]), None
    )
    out = model.scene_features.robot(data.clone())
    assert torch.equal(
        torch.cat([out[key].double() for key in sizes], -1).float(),
        tokens[:, : sum(sizes.values())].float(),
    )
    ends = []
    for ctrl in (data[CTRL], data[CTRL] + 0.1):
        dynamics = NeRDDynamics(model)
        ends.append(dynamics.step(data, torque, None, ctrl)[QVEL])
    assert not torch.equal(*ends)


@pytest.mark.parametrize("network", ["transformer-2x64", "gru"])
def test_streams_are_the_full_sequence(network, arm, generator):
    model = random_model(arm, generator, network)
    model.network.double()
    data = simulated(arm, generator, 3, 8)
    windows = data.windows(torch.arange(3) * 8, 7)
    driven = drive_of(windows[JOINT_TORQUE], windows[CTRL])
    encoded = model.encode(windows[QPOS], windows[QVEL], driven, None)
    whole = model.decode(
        (windows[QPOS], windows[QVEL]), encoded, model.network(encoded.token)
    )
    dynamics = NeRDDynamics(model)
    dynamics.reset(windows[:, 0])
    for step in range(7):
        now = windows[:, step]
        after = dynamics.step(now, now[JOINT_TORQUE], None, now[CTRL])
        for key, want in zip((QPOS, QVEL), whole, strict=True):
            torch.testing.assert_close(after[key], want[:, step], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("compile", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_an_env_of_a_model_hands_out_what_it_was_driven_by(compile, arm, generator):
    model = random_model(arm, generator, "mlp-4x64")
    env = NeRDEnv(SceneTask(arm), model, num_envs=4, seed=0, compile=compile)
    check_env_specs(env)
    rollout = env.rollout(5)
    action = rollout["action"].double()
    torque, ctrl = actuate(arm.controller, action, rollout[QPOS], rollout[QVEL])
    torch.testing.assert_close(rollout[CTRL], ctrl)
    torch.testing.assert_close(rollout["next", "joint_torque"], torque)
    plain = NeRDDynamics(model)
    plain.reset(rollout[:, 0])
    for step in range(5):
        now = rollout[:, step]
        after = plain.step(now, torque[:, step], None, ctrl[:, step])
        torch.testing.assert_close(after[QPOS], now["next", QPOS], rtol=1e-5, atol=1e-5)


def test_a_control_beyond_its_range_is_the_range_end_as_in_mujoco(arm, generator):
    state, torque, _, ctrl = one_step(arm)
    for dynamics in (NeRDDynamics(random_model(arm, generator)), MujocoDynamics(arm)):
        steps = []
        for beyond in (2.0, 7.0, -1e9):  # their range is from -2 to 2
            dynamics.reset(state)
            steps.append(dynamics.step(state, torque, None, beyond * ctrl))
        assert torch.equal(steps[0][QVEL], steps[1][QVEL])
        assert not torch.equal(steps[0][QVEL], steps[2][QVEL])


def test_data_along_a_policy_are_the_servos_motion(arm, generator):
    def actor(shown: TensorDict) -> TensorDict:
        return shown.set("action", 0.3 * shown["observation"][:, :2].sin())

    data = policy_data(SceneTask(arm), actor, 3, 6, generator)
    again = MujocoDynamics(arm).rollout(data[:, 0], None, None, data[CTRL])
    assert torch.equal(again[QPOS], data["next", QPOS])
    other = type("Pushed", (SceneTask,), {"controller": TorqueController((1.0, 1.0))})
    with pytest.raises(ValueError, match="drives the servos of .* TorqueController"):
        policy_data(other(arm), actor, 3, 6, generator)


def test_logs_of_servos_need_their_controls(tmp_path, generator):
    smooth = {"control_step": 0.002, "ctrl": ((0.28, -0.42), (0.32, -0.38))}
    near = {"qpos_low": (0.2, -0.5), "qpos_high": (0.4, -0.3), "qvel_high": (0.1, 0.1)}
    arm = arm_scene(tmp_path, **smooth, **near, qvel_low=(-0.1, -0.1))
    log = simulated(arm, generator, 8, 20)
    arrays = {"qpos": log.qpos, "qvel": log.qvel, "trajectory_offsets": log.offsets}
    np.savez(tmp_path / "bare.npz", **arrays)
    with pytest.raises(ValueError, match="expected 'ctrl' in .*bare.npz, found qpos"):
        read_log(tmp_path / "bare.npz", arm)
    np.savez(tmp_path / "log.npz", **arrays, ctrl=log.ctrl)
    found, _ = load_recording(tmp_path / "log.npz", arm)
    torch.testing.assert_close(found.joint_torque, log.joint_torque)
    data = found.transitions()
    torque, _ = drive(arm, data[CTRL], data[QPOS], data[QVEL])
    torch.testing.assert_close(data["next", "joint_torque"], torque)
    learned = NeRD(
        arm, NO_PREDICTIONS, network_config("mlp-4x64"), data_stats(arm, data[:, None])
    )
    cover(learned, data[:, None])
    config = FinetuneConfig("all", epochs=2.0, batch_size=32, sequence_length=3)
    numbers = torch.arange(8)
    tuner = FineTuner(
        learned, found, numbers[2:], numbers[:2], replace(config, states=6), quiet=True
    )
    tuner.run()
    assert len(tuner.curve) > 1
