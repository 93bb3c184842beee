"""Recorded tosses become the states, transitions and windows they were."""

import numpy as np
import pytest
import torch
from helpers import EXCERPT

from torchrl_nerd.data.cube_tosses import (
    FRAME,
    MEASURED_GRAVITY,
    estimate_velocities,
    make_tosses,
    read_log,
    split_tosses,
)
from torchrl_nerd.data.recorded import read_transitions, write_tosses
from torchrl_nerd.geometry.rotations import quat_exp, quat_multiply


def test_csv_and_npz_give_the_same_tosses(log, tmp_path):
    toss = np.repeat(np.arange(len(log.offsets) - 1), log.offsets.diff())
    columns = (toss[:, None], log.position, log.quaternion, log.linear, log.angular)
    header = "toss,x,y,z,qw,qx,qy,qz,vx,vy,vz,wx,wy,wz"
    path = tmp_path / "log.csv"
    table = np.concatenate([np.asarray(c) for c in columns], 1)
    np.savetxt(path, table, delimiter=",", header=header, comments="", fmt="%.17g")
    found = read_log(path)
    for name, value in vars(log).items():
        other = getattr(found, name)
        assert other is None if value is None else torch.equal(other, value)


def test_transitions_never_cross_from_toss_to_toss(tosses):
    data = tosses.transitions()
    ids = data["collector", "traj_ids"]
    assert len(data) == len(tosses.qpos) - len(tosses)
    moved = torch.linalg.vector_norm(
        (data["next", "qpos"] - data["qpos"])[:, :3], dim=1
    )
    assert moved.max() < 2.0 * FRAME * 2.0  # at most 2 m/s
    follows = ids[1:] == ids[:-1]
    assert torch.equal(data["next", "qpos"][:-1][follows], data["qpos"][1:][follows])


def test_windows_are_consecutive_states_of_one_toss(tosses):
    starts = tosses.starts(80)
    assert torch.equal(tosses.toss_of(starts), tosses.toss_of(starts + 79))
    expected = (tosses.offsets.diff() - 79).clamp_min(0).sum()
    assert len(starts) == expected
    window = tosses.windows(starts[:5], 80)
    assert torch.equal(window["qpos"][1, :-1], window["qpos"][0, 1:])


def test_selected_tosses_are_those_asked_for(tosses, generator):
    numbers = torch.randperm(len(tosses), generator=generator)[:4]
    chosen = tosses.select(numbers)
    for i, number in enumerate(numbers.tolist()):
        mine = chosen.qpos[chosen.offsets[i] : chosen.offsets[i + 1]]
        own = tosses.qpos[tosses.offsets[number] : tosses.offsets[number + 1]]
        assert torch.equal(mine, own)


def test_flight_goes_on_as_gravity_says(tosses, real_cube):
    """Half a frame of gravity makes a recorded velocity that of its pose's time."""
    data = tosses.transitions()
    flies = (real_cube.clearances(data["qpos"]).amin(-1) > 0.02) & (
        real_cube.clearances(data["next", "qpos"]).amin(-1) > 0.02
    )
    fall = torch.tensor([0.0, 0.0, -0.5 * MEASURED_GRAVITY * FRAME**2])
    ahead = data["qpos"][:, :3] + FRAME * data["qvel"][:, :3] + fall
    apart = (ahead - data["next", "qpos"][:, :3])[flies]
    assert flies.sum() > 50
    assert apart.abs().median() < 5e-5  # m; without it 2e-4 along z


def test_velocities_from_poses_are_those_recorded(log):
    linear, angular = estimate_velocities(log)
    assert (linear - log.linear).norm(dim=-1).median() < 0.005  # m/s
    assert (angular - log.angular).norm(dim=-1).median() < 0.02  # rad/s


def test_velocities_of_steady_motion_are_exact(log, generator):
    count = len(log.position)
    velocity, spin = (torch.randn(3, generator=generator).double() for _ in range(2))
    time = FRAME * torch.arange(count, dtype=torch.float64)[:, None]
    start = torch.nn.functional.normalize(
        torch.randn(4, generator=generator).double(), dim=0
    )
    turned = quat_multiply(start.expand(count, 4), quat_exp(time * spin))
    steady = type(log)(time * velocity, turned, None, None, log.offsets)
    linear, angular = estimate_velocities(steady)
    torch.testing.assert_close(linear, velocity.expand(count, 3), atol=1e-9, rtol=0)
    torch.testing.assert_close(angular, spin.expand(count, 3), atol=1e-9, rtol=0)


def test_poses_alone_are_enough(log, real_cube):
    poses = type(log)(log.position, log.quaternion, None, None, log.offsets)
    assert make_tosses(poses, real_cube).qvel.isfinite().all()


def test_the_split_is_the_published_one():
    split = split_tosses(510)
    assert [len(x) for x in split.values()] == [380, 65, 65]
    assert torch.equal(torch.cat(list(split.values())).sort().values, torch.arange(510))
    order = np.random.default_rng(0).permutation(510)
    assert split["test"].tolist() == order[445:].tolist()


def test_a_data_set_holds_what_was_recorded(real_cube, tosses, tmp_path):
    card = write_tosses(EXCERPT, real_cube, tmp_path / "set")
    data = read_transitions(tmp_path / "set")
    assert card["trajectories"] == len(tosses) and len(card["checks"]) >= 5
    assert torch.equal(data["qpos"], tosses.transitions()["qpos"])
    with pytest.raises(ValueError, match="already holds data"):
        write_tosses(EXCERPT, real_cube, tmp_path / "set")


@pytest.mark.parametrize(
    "spoil, said",
    [
        (lambda a: a.pop("position"), "'position'"),
        (lambda a: a.update(quaternion_wxyz=a["quaternion_wxyz"][:-1]), "of shape"),
        (lambda a: a.update(trajectory_offsets=np.array([0, 7])), "trajectory_offsets"),
        (lambda a: a["position"].__setitem__((3, 1), np.nan), "finite"),
    ],
)
def test_a_broken_file_is_refused_in_one_sentence(spoil, said, tmp_path):
    with np.load(EXCERPT) as file:
        arrays = {name: file[name].copy() for name in file.files}
    spoil(arrays)
    np.savez(tmp_path / "log.npz", **arrays)
    with pytest.raises(ValueError, match=said):
        read_log(tmp_path / "log.npz")


def test_pickled_arrays_are_refused(tmp_path):
    np.savez(tmp_path / "log.npz", position=np.array([{}], dtype=object))
    with pytest.raises(ValueError, match="expected an npz file"):
        read_log(tmp_path / "log.npz")
