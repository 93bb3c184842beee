"""Errors over recorded trajectories: zero for the recording, intervals that cover."""

import math

import pytest
import torch
from helpers import simulated
from tensordict import TensorDict

from torchrl_nerd import load_scene
from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.evaluation.bench.candidates import NoMotion
from torchrl_nerd.evaluation.recorded_error import (
    compare,
    error_key,
    paired_interval,
    resampled_means,
    summarize_windows,
    window_errors,
)


class Replay:
    """Dynamics that know the recording: the row after the one that they are given."""

    def __init__(self, scene, recording):
        self.scene, self.recording = scene, recording

    def reset(self, state, is_reset=None):
        pass

    def step(self, state, joint_torque, terrain=None, ctrl=None):
        apart = torch.cdist(state["qpos"], self.recording.qpos)
        after = apart.argmin(1) + 1
        values = {
            "qpos": self.recording.qpos[after],
            "qvel": self.recording.qvel[after],
        }
        return TensorDict(values, state.batch_size)


def test_the_recording_itself_has_no_error(real_cube, recording, generator):
    starts = recording.starts(80)
    pick = starts[torch.randint(len(starts), (3,), generator=generator)]
    errors = window_errors(Replay(real_cube, recording), recording, pick)
    distance, angle = errors["base_position"], errors["base_orientation"]
    assert distance.shape == angle.shape == (3, 79)
    assert distance.max() == 0.0 and angle.max() < 1e-7


def test_results_agree_with_their_definitions(real_cube, recording):
    starts = recording.starts(80)
    errors = window_errors(NoMotion(real_cube), recording, starts)
    summary = summarize_windows(real_cube, errors, recording, starts)
    assert summary.keys() == {"position_error_m", "orientation_error_rad"}
    for error, result in zip(errors.values(), summary.values(), strict=True):
        first = torch.isin(starts, recording.offsets)
        assert math.isclose(result["mean"], error.mean(), rel_tol=1e-6)
        assert math.isclose(result["final"], error[:, -1].mean(), rel_tol=1e-6)
        assert math.isclose(result["first"], error[first].mean(), rel_tol=1e-6)
        assert result["median"] <= result["p95"]
        assert 0 < result["interval"] < result["mean"]


def test_intervals_come_from_trajectories_not_from_windows(generator):
    """Of a hundred alike windows per trajectory only the trajectories' number counts."""
    means = torch.randn(40, generator=generator).double()
    group = torch.arange(40).repeat_interleave(100)
    drawn = resampled_means(means.repeat_interleave(100), group, draws=4000)
    expected = means.std(correction=0) / 40**0.5
    assert 0.9 < drawn.std() / expected < 1.1
    low, high = paired_interval(means[group, None], means[group, None] + 1.0, group)
    assert math.isclose(low, -1.0) and math.isclose(high, -1.0)


@pytest.mark.parametrize("name", ["cartpole", "double_pendulum", "franka", "ant"])
def test_the_dynamics_of_any_log_have_no_error_on_it(name, generator):
    """The recorded torques are applied, in the recorded order."""
    scene = load_scene(name)
    log = simulated(scene, generator, states=6)
    starts = log.offsets[:-1]
    errors = window_errors(MujocoDynamics(scene), log, starts, states=6)
    assert max(float(error.max()) for error in errors.values()) < 1e-6
    still = window_errors(NoMotion(scene), log, starts, states=6)
    assert all(float(error.mean()) > 1e-4 for error in still.values())
    keys = [error_key(scene, quantity) for quantity in errors]
    assert len(set(keys)) == len(keys)
    assert all(key.endswith(("_error_m", "_error_rad")) for key in keys)


def test_models_are_compared_in_pairs(real_cube, recording):
    starts = recording.starts(80)[:20]
    models = {"a": Replay(real_cube, recording), "b": Replay(real_cube, recording)}
    table = compare(models, real_cube, recording, starts)
    assert table.keys() == {"no motion", "a", "b"}
    assert table["a"]["against"] == {"b": {"m": (0.0, 0.0), "rad": (0.0, 0.0)}}
    apart = table["no motion"]["against"]["a"]["m"]
    assert 0.0 < apart[0] <= table["no motion"]["position_error_m"]["mean"] <= apart[1]


def test_one_trajectory_has_no_interval():
    a, b, group = torch.ones(4, 9), torch.zeros(4, 9), torch.zeros(4, dtype=torch.long)
    assert all(math.isnan(end) for end in paired_interval(a, b, group))
