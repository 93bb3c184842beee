"""Recorded logs become the states, transitions and windows they were."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import EXCERPT, simulated
from tensordict import TensorDict

from torchrl_nerd import load_scene
from torchrl_nerd.data.log_files import load_recording, read_log, write_recording
from torchrl_nerd.data.recorded import (
    FEWEST,
    Recording,
    complete,
    estimate_velocities,
    free_fall,
    split_trajectories,
)
from torchrl_nerd.data.simulate import as_transitions
from torchrl_nerd.data.store import chunk_path, read_chunk
from torchrl_nerd.geometry.manifold import integrate_pos
from torchrl_nerd.scenes import Scene


def write_csv(path, header, *columns):
    table = np.concatenate([np.asarray(c) for c in columns], 1)
    np.savetxt(path, table, delimiter=",", header=header, comments="", fmt="%.17g")


def numbers(log):
    """The trajectory of every frame, as a column."""
    return log.trajectory_of(torch.arange(len(log.qpos)))[:, None]


def same(a, b):
    return all(
        torch.equal(x, y) if isinstance(x, torch.Tensor) else x == y
        for x, y in zip(vars(a).values(), vars(b).values(), strict=True)
    )


def test_csv_and_npz_give_the_same_tosses(log, real_cube, tmp_path):
    header = "trajectory,x,y,z,qw,qx,qy,qz,vx,vy,vz,wx,wy,wz"
    write_csv(tmp_path / "log.csv", header, numbers(log), log.qpos, log.qvel)
    assert same(read_log(tmp_path / "log.csv", real_cube), log)


@pytest.mark.parametrize("kind", ["npz", "csv"])
def test_a_log_of_any_robot_comes_back(kind, generator, tmp_path):
    scene = load_scene("cartpole")
    log, path = simulated(scene, generator), tmp_path / f"log.{kind}"
    time = log.frame * torch.arange(len(log.qpos))
    if kind == "csv":
        header = "trajectory,qpos_0,qpos_1,qvel_0,qvel_1,joint_torque_0,time"
        columns = log.qpos, log.qvel, log.joint_torque, time[:, None]
        write_csv(path, header, numbers(log), *columns)
    else:
        names = ("qpos", "qvel", "joint_torque")
        arrays = {name: getattr(log, name).numpy() for name in names}
        np.savez(path, trajectory=numbers(log)[:, 0], time=time, **arrays)
    found, split = load_recording(path, scene)
    assert found.frame == pytest.approx(log.frame)
    assert same(replace(found, frame=log.frame, time=None), log)
    assert sum(len(members) for members in split.values()) == len(log)
    window = found.windows(found.starts(5)[:1], 5)
    assert torch.equal(window["next", "joint_torque"][0], log.joint_torque[:5])


def test_positions_alone_are_enough_for_any_robot(generator):
    scene = load_scene("cartpole")
    log = simulated(scene, generator)
    found = complete(replace(log, qvel=torch.full_like(log.qvel, torch.nan)), scene)
    apart, speed = (found.qvel - log.qvel).norm(dim=1), log.qvel.norm(dim=1)
    assert apart.median() < 0.2 * speed.median()


def test_transitions_never_cross_from_toss_to_toss(recording):
    data = recording.transitions()
    ids = data["collector", "traj_ids"]
    assert len(data) == len(recording.qpos) - len(recording)
    moved = torch.linalg.vector_norm(
        (data["next", "qpos"] - data["qpos"])[:, :3], dim=1
    )
    assert moved.max() < 2.0 * recording.frame * 2.0  # at most 2 m/s
    follows = ids[1:] == ids[:-1]
    assert torch.equal(data["next", "qpos"][:-1][follows], data["qpos"][1:][follows])


def test_windows_are_consecutive_states_of_one_toss(recording):
    starts = recording.starts(80)
    assert torch.equal(
        recording.trajectory_of(starts), recording.trajectory_of(starts + 79)
    )
    expected = (recording.offsets.diff() - 79).clamp_min(0).sum()
    assert len(starts) == expected
    window = recording.windows(starts[:5], 80)
    assert torch.equal(window["qpos"][1, :-1], window["qpos"][0, 1:])


def test_selected_tosses_are_those_asked_for(recording, generator):
    numbers = torch.randperm(len(recording), generator=generator)[:4]
    chosen = recording.select(numbers)
    for i, number in enumerate(numbers.tolist()):
        mine = chosen.qpos[chosen.offsets[i] : chosen.offsets[i + 1]]
        own = recording.qpos[recording.offsets[number] : recording.offsets[number + 1]]
        assert torch.equal(mine, own)


def test_flight_goes_on_as_gravity_says(recording, real_cube):
    """Half a frame of gravity makes a recorded velocity that of its pose's time."""
    data = recording.transitions()
    is_airborne = (real_cube.clearances(data["qpos"]).amin(-1) > 0.02) & (
        real_cube.clearances(data["next", "qpos"]).amin(-1) > 0.02
    )
    frame = recording.frame
    fall = 0.5 * frame**2 * free_fall(recording)
    ahead = data["qpos"][:, :3] + frame * data["qvel"][:, :3] + fall
    apart = (ahead - data["next", "qpos"][:, :3])[is_airborne]
    assert is_airborne.sum() > 50
    assert apart.abs().median() < 5e-5  # m; without it 2e-4 along z


def test_velocities_of_their_poses_own_time_are_kept(real_cube, generator):
    log = simulated(real_cube, generator)
    apart = complete(log, real_cube).qvel - log.qvel
    assert apart.abs().max() < 0.1 * 9.81 * 0.5 * log.frame


def test_velocities_from_poses_are_those_recorded(log, real_cube):
    apart = estimate_velocities(log, real_cube) - log.qvel
    assert apart[:, :3].norm(dim=-1).median() < 0.005  # m/s
    assert apart[:, 3:].norm(dim=-1).median() < 0.02  # rad/s


def test_velocities_of_steady_motion_are_exact(log, real_cube, generator):
    qvel = torch.randn(6, generator=generator).double().expand(len(log.qpos), 6)
    time = log.frame * torch.arange(len(log.qpos), dtype=torch.float64)[:, None]
    start = log.qpos[:1].expand_as(log.qpos)
    qpos = integrate_pos(real_cube.layout, start, time * qvel)
    found = estimate_velocities(replace(log, qpos=qpos), real_cube)
    torch.testing.assert_close(found, qvel, atol=1e-8, rtol=0)


def test_poses_alone_are_enough(log, recording, real_cube):
    poses = replace(log, qvel=torch.full_like(log.qvel, torch.nan))
    found = complete(poses, real_cube).qvel
    assert (found - recording.qvel).norm(dim=-1).median() < 0.02


def test_the_split_is_the_published_one():
    split = split_trajectories(510)
    assert [len(x) for x in split.values()] == [380, 65, 65]
    assert torch.equal(torch.cat(list(split.values())).sort().values, torch.arange(510))
    order = np.random.default_rng(0).permutation(510)
    assert split["test"].tolist() == order[445:].tolist()


@pytest.mark.parametrize(
    ("count", "empty"), [(1, "validation and test"), (2, "validation"), (5, "test")]
)
def test_an_empty_split_is_named(count, empty, generator):
    log = simulated(load_scene("cartpole"), generator, trajectories=count)
    said = f"got a log of {count} with none for {empty}: cut it into at least 6 "
    with pytest.raises(ValueError, match=said):
        for members in split_trajectories(count).values():
            log.starts(2, members)


def test_six_trajectories_leave_no_split_empty():
    for count in range(FEWEST - 1, 100):
        sizes = [len(members) for members in split_trajectories(count).values()]
        assert all(sizes) == (count >= FEWEST)


def test_a_data_set_holds_what_was_recorded(real_cube, recording, tmp_path):
    card = write_recording(EXCERPT, real_cube, tmp_path / "set")
    data = read_chunk(chunk_path(tmp_path / "set", 0), 1)
    assert card["trajectories"] == len(recording) and len(card["checks"]) >= 5
    assert torch.equal(data["qpos"], recording.transitions()["qpos"])
    with pytest.raises(ValueError, match="already holds data"):
        write_recording(EXCERPT, real_cube, tmp_path / "set")


@pytest.mark.parametrize(
    "spoil, said",
    [
        (lambda a: a.pop("position"), "'position'"),
        (lambda a: a.update(quaternion_wxyz=a["quaternion_wxyz"][:-1]), "of shape"),
        (lambda a: a.update(trajectory_offsets=np.array([0, 7])), "trajectory_offsets"),
        (lambda a: a["position"].__setitem__((3, 1), np.nan), "finite"),
        (lambda a: a.update(qpos=a["position"]), "'qpos' of shape"),
    ],
)
def test_a_broken_file_is_refused_in_one_sentence(spoil, said, real_cube, tmp_path):
    with np.load(EXCERPT) as file:
        arrays = {name: file[name].copy() for name in file.files}
    spoil(arrays)
    np.savez(tmp_path / "log.npz", **arrays)
    with pytest.raises(ValueError, match=said):
        read_log(tmp_path / "log.npz", real_cube)


def test_pickled_arrays_are_refused(real_cube, tmp_path):
    np.savez(tmp_path / "log.npz", position=np.array([{}], dtype=object))
    with pytest.raises(ValueError, match="expected an npz file"):
        read_log(tmp_path / "log.npz", real_cube)


def test_a_log_of_another_robot_is_refused(generator, tmp_path):
    log = simulated(load_scene("cartpole"), generator)
    np.savez(tmp_path / "log.npz", qpos=log.qpos, qvel=log.qvel)
    with pytest.raises(ValueError, match="'qpos' of shape .* got"):
        read_log(tmp_path / "log.npz", load_scene("ant"))
    with pytest.raises(ValueError, match="expected 'qpos'"):
        read_log(EXCERPT, load_scene("ant"))


CARTPOLE = ("qpos_0", "qpos_1", "qvel_0", "qvel_1", "joint_torque_0")


def cartpole_csv(path, generator, *names, **more):
    """A log of cartpoles under these names of its columns, and ``more`` columns."""
    log = simulated(load_scene("cartpole"), generator)
    columns = [numbers(log), log.qpos, log.qvel, log.joint_torque]
    columns += [np.full((len(log.qpos), 1), value) for value in more.values()]
    header = ",".join((*(names or ("trajectory", *CARTPOLE)), *more))
    write_csv(path, header, *columns)
    return log


def test_other_columns_of_a_csv_are_ignored(generator, tmp_path):
    path, scene = tmp_path / "log.csv", load_scene("cartpole")
    log = cartpole_csv(path, generator, joint_torque_measured=1.0, qvel_raw_0=2.0)
    assert same(read_log(path, scene), log)
    path.write_text("\ufeff" + path.read_text())  # as Excel writes it
    assert same(read_log(path, scene), log)


@pytest.mark.parametrize(
    ("names", "said"),
    [
        (("trajectory", *CARTPOLE[:4], "joint_torque_1"), "none named joint_torque_0"),
        (("Trajectory", *CARTPOLE), "a column 'trajectory' .* got 'Trajectory'"),
        (("trajectory", *CARTPOLE[:4], "qpos_0"), "one column 'qpos_0' .* got several"),
        (("trajectory_offsets", *CARTPOLE), "'trajectory' .* got 'trajectory_offsets'"),
        (("trajectory", *CARTPOLE[:4], "torque_0"), "of 'joint_torque' .* 'torque_0'"),
    ],
)
def test_columns_that_are_nearly_right_are_refused(names, said, generator, tmp_path):
    cartpole_csv(tmp_path / "log.csv", generator, *names)
    with pytest.raises(ValueError, match=said):
        read_log(tmp_path / "log.csv", load_scene("cartpole"))


@pytest.mark.parametrize("dtype", [np.longdouble, ">f8", np.float32, np.int16])
def test_numbers_of_any_type_are_read(dtype, tmp_path):
    qpos = np.arange(8).reshape(4, 2)
    np.savez(tmp_path / "log.npz", qpos=qpos.astype(dtype))
    found = read_log(tmp_path / "log.npz", load_scene("cartpole"))
    assert found.qpos.tolist() == qpos.tolist()


@pytest.mark.parametrize("count", [0, 1])
def test_a_log_of_no_motion_is_refused(count, tmp_path):
    np.savez(tmp_path / "log.npz", qpos=np.zeros((count, 2)))
    with pytest.raises(ValueError, match=f"at least 2 frames in .*, got {count}"):
        read_log(tmp_path / "log.npz", load_scene("cartpole"))


def test_a_pose_without_one_of_its_columns_is_refused(log, real_cube, tmp_path):
    header = "trajectory,x,y,z,qw,qx,qy,qz,vx,vy"
    write_csv(tmp_path / "log.csv", header, numbers(log), log.qpos, log.qvel[:, :2])
    with pytest.raises(ValueError, match="expected columns vx, vy, vz .* named vz"):
        read_log(tmp_path / "log.csv", real_cube)


@pytest.mark.parametrize(
    ("trajectory", "said"),
    [
        (np.arange(120) % 2, "got one of one frame in row 0"),
        (np.arange(120) // 30 % 2, "got several pieces"),
        (np.arange(120) // 60, "by 'trajectory' and 'trajectory_offsets'"),
    ],
)
def test_trajectories_are_whole(trajectory, said, generator, tmp_path):
    scene, path = load_scene("cartpole"), tmp_path / "log.npz"
    log = simulated(scene, generator)
    how = {"trajectory_offsets": log.offsets} if "offsets" in said else {}
    np.savez(path, qpos=log.qpos, qvel=log.qvel, trajectory=trajectory, **how)
    with pytest.raises(ValueError, match=said):
        read_log(path, scene)


def test_estimated_velocities_of_a_fall_are_exact_from_the_first_frame_on(real_cube):
    frame, gravity = real_cube.control_step, real_cube.model.opt.gravity[2]
    t = frame * torch.arange(12, dtype=torch.float64)
    qpos = torch.zeros(12, 7, dtype=torch.float64)
    qpos[:, 2], qpos[:, 3] = 1.0 + 0.5 * t + 0.5 * gravity * t**2, 1.0
    none = torch.full((12, 6), torch.nan, dtype=torch.float64)
    no_torque, offsets = torch.zeros(12, 0).double(), torch.tensor([0, 12])
    found = complete(Recording(qpos, none, no_torque, offsets, frame), real_cube)
    torch.testing.assert_close(found.qvel[:, 2], 0.5 + gravity * t)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("joint_torques", "an array 'joint_torque' in .*, got 'joint_torques'"),
        ("Trajectory", "an array 'trajectory' in .*, got 'Trajectory'"),
        ("ctrl", "'joint_torque' in .* of the motors of 'cartpole', got 'ctrl'"),
    ],
)
def test_arrays_that_would_be_left_out_are_refused(name, words, tmp_path):
    """Not read as a robot that nothing drives."""
    path, frames = tmp_path / "log.npz", np.zeros((9, 2))
    np.savez(path, qpos=frames, qvel=frames, **{name: np.ones((9, 1))})
    with pytest.raises(ValueError, match=words):
        read_log(path, load_scene("cartpole"))


def test_a_free_body_without_a_ground_is_in_flight(tmp_path):
    body = '<body pos="0 0 1"><freejoint/><geom type="box" size=".1 .1 .1"/></body>'
    (tmp_path / "body.xml").write_text(
        f"<mujoco><worldbody>{body}</worldbody></mujoco>"
    )
    scene = Scene.from_mjcf(tmp_path / "body.xml", control_step=0.01)
    time, speeds = 0.01 * np.arange(20), np.arange(1, 7) / 10.0
    qpos = np.zeros((6, 20, 7))
    qpos[..., 2] = 1.0 + speeds[:, None] * time - 0.5 * 9.81 * time**2
    qpos[..., 3] = 1.0
    numbers = np.repeat(np.arange(6), 20)
    np.savez(tmp_path / "log.npz", qpos=qpos.reshape(-1, 7), trajectory=numbers)
    log, _ = load_recording(tmp_path / "log.npz", scene)
    expected = torch.tensor(speeds[:, None] - 9.81 * time)
    torch.testing.assert_close(
        log.qvel[:, 2].reshape(6, 20)[:, 1:], expected[:, 1:], atol=1e-6, rtol=0.0
    )


def test_other_columns_are_left_alone(generator, tmp_path):
    """As other arrays of an npz file are; an ending may be in capitals."""
    others = "position_0", "tool_position_0", "velocity_0", "time_step_0"
    more = dict.fromkeys(others, 1.0)
    log = cartpole_csv(tmp_path / "log.CSV", generator, **more)
    assert same(read_log(tmp_path / "log.CSV", load_scene("cartpole")), log)


def test_a_control_beyond_its_range_is_clipped_as_mujoco_does(tmp_path):
    (tmp_path / "arm.xml").write_text("""<mujoco><worldbody><body><joint name="j"/>
      <geom size="0.1" pos="0.2 0 0"/></body></worldbody><actuator>
      <position joint="j" kp="10" ctrllimited="true" ctrlrange="-1 1"/></actuator>
      </mujoco>""")
    scene = Scene.from_mjcf(tmp_path / "arm.xml")
    zero = torch.zeros(3, 1).double()
    frames = {"offsets": torch.tensor([0, 3]), "frame": scene.control_step}
    log = Recording(zero, zero, zero, **frames, ctrl=zero + 3.0)
    found = complete(log, scene)
    still = TensorDict({"qpos": zero[None, :2], "qvel": zero[None, :2]}, [1, 2])
    drawn = as_transitions(scene, [still], [torch.full((1, 1, 1), 3.0).double()], None)
    assert (
        drawn["next", "ctrl"].item() == 1.0
        and drawn["next", "joint_torque"].item() == 10.0
    )
    torch.testing.assert_close(found.joint_torque, zero + 10.0)
    torch.testing.assert_close(found.ctrl, zero + 1.0)
