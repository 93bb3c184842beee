"""Batches: windows of single trajectories, and statistics of the whole data set."""

import pytest
import torch
from helpers import mujoco_step
from tensordict import TensorDict
from torch import Generator

from torchrl_nerd.configs import NO_PREDICTIONS
from torchrl_nerd.data.simulate import is_sound, simulate
from torchrl_nerd.modules.nerd import TARGET, TOKEN, NeRD
from torchrl_nerd.modules.networks import MLPConfig
from torchrl_nerd.training import samples as samples_module
from torchrl_nerd.training.samples import data_stats, raw_tokens
from torchrl_nerd.training.sequences import Sequences

STEPS = 6


@pytest.fixture
def data(scene, generator) -> TensorDict:
    data = simulate(scene, 40, STEPS, generator)
    return data[is_sound(data)]


@pytest.fixture
def model(scene, data) -> NeRD:
    return NeRD(scene, NO_PREDICTIONS, MLPConfig(1, 4), data_stats(scene, data))


@pytest.fixture
def sequences(model, data) -> Sequences:
    return Sequences(model, data)


@pytest.mark.parametrize("length", [1, 4, STEPS])
def test_windows_lie_inside_one_trajectory(length, sequences, data, seed):
    qpos, qvel, torque, terrain, _ = sequences.rollout(
        300, length, Generator().manual_seed(seed)
    )
    assert qpos.shape[:2] == qvel.shape[:2] == (300, length + 1)
    every = torch.cat((data["qpos"], data["next", "qpos"][:, -1:]), 1)
    windows = every.unfold(1, length + 1, 1).movedim(-1, 2)
    is_there = (windows[None] == qpos[:, None, None]).all((-1, -2))
    assert (is_there.sum((1, 2)) == 1).all()
    _, row, start = is_there.nonzero().unbind(1)
    assert set(start.tolist()) == set(range(STEPS - length + 1))
    assert len(set(row.tolist())) > 0.9 * len(data)
    time = start[:, None] + torch.arange(length)
    assert torch.equal(qvel[:, :-1], data["qvel"][row[:, None], time])
    assert torch.equal(torque, data["next", "joint_torque"][row[:, None], time])
    if terrain is not None:
        assert torch.equal(terrain, data["terrain"][row, start])


def test_windows_move_as_the_ground_truth_does(scene, sequences, generator):
    qpos, qvel, torque, terrain, _ = sequences.rollout(20, 3, generator)
    for t in range(3):
        state = {"qpos": qpos[:, t], "qvel": qvel[:, t]}
        if terrain is not None:
            state["terrain"] = terrain
        after = mujoco_step(scene, TensorDict(state, batch_size=[20]), torque[:, t])
        torch.testing.assert_close(
            after["next", "qpos"], qpos[:, t + 1], rtol=1e-7, atol=1e-6
        )


def test_tokens_and_targets_are_those_of_the_windows(model, sequences, seed):
    inputs, targets = sequences.one_step(50, 4, Generator().manual_seed(seed))
    qpos, qvel, torque, terrain, _ = sequences.rollout(
        50, 4, Generator().manual_seed(seed)
    )
    ground = None if terrain is None else terrain[:, None].expand(-1, 4, -1)
    state = qpos[:, :-1], qvel[:, :-1]
    encoded = model.encode(*state, torque, ground)
    torch.testing.assert_close(inputs.token, encoded.token, rtol=1e-5, atol=1e-6)
    decoded = model.decode(state, encoded, targets.double())
    torch.testing.assert_close(decoded[0], qpos[:, 1:], rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(decoded[1], qvel[:, 1:], rtol=1e-4, atol=1e-4)


def test_batches_depend_on_the_generator_alone(sequences, seed):
    first = sequences.one_step(9, 3, Generator().manual_seed(seed))
    torch.rand(3)
    second = sequences.one_step(9, 3, Generator().manual_seed(seed))
    third = sequences.one_step(9, 3, Generator().manual_seed(seed + 1))
    assert torch.equal(first[0].token, second[0].token)
    assert torch.equal(first[1], second[1])
    assert not torch.equal(first[0].token, third[0].token)


def test_statistics_are_those_of_the_whole_data_set(scene, generator, monkeypatch):
    monkeypatch.setattr(samples_module, "PART", 256)
    data = simulate(scene, 428, 2, generator)
    data = data[is_sound(data)]
    model = NeRD(scene, NO_PREDICTIONS, MLPConfig(1, 4))
    stats = data_stats(scene, data)
    whole = raw_tokens(model.scene_features, model.state_delta, data)
    for key, samples in zip((TOKEN, TARGET), whole, strict=True):
        samples = samples.flatten(0, 1)
        assert stats[key].count == len(samples)
        torch.testing.assert_close(stats[key].mean, samples.mean(0))
        std = samples.std(0, correction=0)
        moving = std > 1e-5 * (1.0 + samples.mean(0).abs())
        assert moving.any()
        torch.testing.assert_close(stats[key].std[moving], std[moving])


def test_normalised_data_have_mean_zero_and_size_one(model, sequences):
    for key, x in ((TOKEN, sequences.features), (TARGET, sequences.targets)):
        x = x.flatten(0, 1).double()
        hardly_moves = model.normalize.std(key) < 1e-5  # near the floor, or on it
        std = x.std(0, correction=0)
        torch.testing.assert_close(x.mean(0), torch.zeros_like(std), rtol=0, atol=1e-4)
        assert (((std - 1.0).abs() < 1e-3) | hardly_moves & (std < 1.001)).all()
