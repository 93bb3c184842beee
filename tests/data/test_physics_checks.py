"""Logs in wrong units or frames are refused by the physics check that they fail."""

from dataclasses import replace

import pytest
import torch
from helpers import simulated

from torchrl_nerd import load_scene
from torchrl_nerd.data.physics_checks import check_log
from torchrl_nerd.data.recorded import CLEAR, complete
from torchrl_nerd.geometry.rotations import quat_multiply, rotate, rotate_inverse
from torchrl_nerd.scenes import Scene

XYZW = [1, 2, 3, 0]
NONE = torch.nan  # of velocities that were not recorded


def changed(log, position=None, quat=None, linear=None, angular=None):
    """The log with some of its columns replaced."""
    parts = log.qpos[:, :3], log.qpos[:, 3:], log.qvel[:, :3], log.qvel[:, 3:]
    others = position, quat, linear, angular
    p, q, v, w = (a if b is None else b for a, b in zip(parts, others, strict=True))
    v, w = (torch.as_tensor(x).expand(len(p), 3) for x in (v, w))
    return replace(log, qpos=torch.cat((p, q), 1), qvel=torch.cat((v, w), 1))


def position(log):
    return log.qpos[:, :3]


def quat(log):
    return log.qpos[:, 3:]


def linear(log):
    return log.qvel[:, :3]


def angular(log):
    return log.qvel[:, 3:]


def without(log, row: int, count: int):
    """The log with ``count`` frames lost from ``row`` on."""
    index = torch.arange(len(log.qpos))
    keep = (index < row) | (index >= row + count)
    offsets = log.offsets - count * (log.offsets > row).long()
    kept = {name: getattr(log, name)[keep] for name in ("qpos", "qvel", "joint_torque")}
    return replace(log, **kept, offsets=offsets)


def test_real_tosses_pass_with_all_that_was_asked(log, real_cube):
    checks = check_log(log, real_cube)
    assert len(checks) == 7 and all(check.passes for check in checks)


def test_the_ground_is_each_trajectorys_own(generator):
    scene = load_scene("cube_slope")
    log = simulated(scene, generator, states=120)
    assert all(check.passes for check in check_log(log, scene))
    touches = scene.clearances(log.qpos, log.terrain).amin(-1) <= CLEAR
    found = complete(log, scene)  # which corrects velocities in flight alone
    assert 0.2 < touches.double().mean() < 0.98
    assert torch.equal(found.qvel[touches], log.qvel[touches])


def test_where_they_are_and_face_does_not_matter(log, real_cube, generator):
    angle, shift = torch.randn(2, generator=generator).double()
    turn = torch.stack(((0.5 * angle).cos(), *angle.new_zeros(2), (0.5 * angle).sin()))
    turn = turn.expand(len(log.qpos), 4)
    move = torch.stack((shift, -2.0 * shift, 0.0 * shift))
    moved = changed(
        log,
        rotate(turn, position(log)) + move,
        quat_multiply(turn, quat(log)),
        rotate(turn, linear(log)),
    )
    assert len(check_log(moved, real_cube)) == 7


def test_poses_alone_pass(log, real_cube):
    check_log(changed(log, linear=NONE, angular=NONE), real_cube)


WRONG = {
    "half widths": (
        lambda g: changed(g, position(g) / 0.0524, linear=linear(g) / 0.0524),
        ("free fall", "-18"),
    ),
    "millimetres": (
        lambda g: changed(g, 1e3 * position(g), linear=1e3 * linear(g)),
        ("free fall", "multiplied by about 0.001"),
    ),
    "y up": (
        lambda g: changed(g, position(g)[:, [0, 2, 1]]),
        ("free fall", "y axis falls"),
    ),
    "z down": (
        lambda g: changed(g, -position(g), linear=-linear(g)),
        ("free fall", "z points down"),
    ),
    "xyzw": (
        lambda g: changed(g, quat=quat(g)[:, XYZW]),
        ("under the ground", "read as xyzw"),
    ),
    "xyzw, poses alone": (
        lambda g: changed(g, quat=quat(g)[:, XYZW], linear=NONE, angular=NONE),
        ("under the ground", "read as xyzw"),
    ),
    "angular velocity in world axes": (
        lambda g: changed(g, angular=rotate(quat(g), angular(g))),
        ("angular velocity in body axes", "world axes"),
    ),
    "degrees": (
        lambda g: changed(g, angular=torch.rad2deg(angular(g))),
        ("angular velocity", "degrees"),
    ),
    "linear velocity in body axes": (
        lambda g: changed(g, linear=rotate_inverse(quat(g), linear(g))),
        ("linear velocity", "body axes"),
    ),
    "not unit": (
        lambda g: changed(g, quat=1.1 * quat(g)),
        ("length of quaternions", "0.1"),
    ),
    "another frame rate": (
        lambda g: replace(
            g, time=torch.arange(len(g.qpos)).double() / 100.0, frame=0.01
        ),
        ("frame over the scene's control step", "1.48"),
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_log_is_refused_by_its_check(log, real_cube, name):
    spoil, said = WRONG[name]
    with pytest.raises(ValueError) as refusal:
        check_log(spoil(log), real_cube)
    sentence = str(refusal.value)
    assert "\n" not in sentence and "expected" in sentence
    assert all(part in sentence for part in said), sentence


@pytest.mark.parametrize("count", [1, 4, 16])
def test_lost_frames_are_found(log, real_cube, generator, count):
    toss = int(torch.randint(len(log.offsets) - 1, (), generator=generator))
    first, end = log.offsets[toss : toss + 2].tolist()
    rows = torch.arange(first + 2, end - count - 1)
    apart = position(log)[rows + count] - position(log)[rows - 1]
    rows = rows[torch.linalg.vector_norm(apart, dim=-1) > 0.01]
    row = int(rows[torch.randint(len(rows), (), generator=generator)])
    corrupted = [without(log, row, count)]
    if count > 1:  # one frame of an impact: poses alone do not tell
        corrupted.append(changed(corrupted[0], linear=NONE, angular=NONE))
    for wrong in corrupted:
        with pytest.raises(ValueError, match="lost, before frame"):
            check_log(wrong, real_cube)


def test_a_gap_between_time_stamps_is_found(log, real_cube):
    time = torch.arange(len(log.qpos)).double() / 148.0
    check_log(replace(log, time=time), real_cube)
    time[40:] += 0.05
    with pytest.raises(ValueError, match="gap in time"):
        check_log(replace(log, time=time), real_cube)


@pytest.mark.parametrize("name", ["cartpole", "ant"])
def test_velocities_of_other_robots_are_checked(name, generator):
    log = simulated(load_scene(name), generator)
    scene = load_scene(name)
    (*_, check) = check_log(log, scene)
    assert check.name == "qvel against differences of qpos" and check.passes
    for factor in (0.5, 57.3):
        with pytest.raises(ValueError, match="qvel against differences"):
            check_log(replace(log, qvel=factor * log.qvel), scene)
    check_log(replace(log, qvel=torch.full_like(log.qvel, NONE)), scene)


def test_a_robot_that_stands_most_of_the_time_passes(generator):
    """Encoders at rest read a constant, and velocities a little noise."""
    log = simulated(load_scene("cartpole"), generator, states=60)
    stands = torch.arange(len(log.qpos)) % 60 >= 20
    held = log.qpos[20::60].repeat_interleave(60, 0)
    noise = 1e-4 * torch.randn(log.qvel.shape, generator=generator).double()
    qpos = torch.where(stands[:, None], held, log.qpos)
    qvel = torch.where(stands[:, None], 0.0, log.qvel) + noise
    check_log(replace(log, qpos=qpos, qvel=qvel), load_scene("cartpole"))


@pytest.mark.parametrize(
    "name", ["gymnasium/HalfCheetah-v5", "dm_control/reacher-easy", "cube_real"]
)
def test_exact_motion_passes(name, generator):
    """Dampers and impacts change a velocity within a frame."""
    scene = load_scene(name)
    log = simulated(scene, generator, states=80)
    check_log(log, scene)
    if name != "cube_real":  # and half of the frames, called all of them, do not
        with pytest.raises(ValueError, match="frames are of another length"):
            half = {key: getattr(log, key)[::2] for key in ("qpos", "qvel")}
            torque, offsets = log.joint_torque[::2], log.offsets // 2
            check_log(replace(log, **half, joint_torque=torque, offsets=offsets), scene)


@pytest.mark.parametrize(
    ("option", "body"), [('gravity="0 0 0"', ""), ("", 'gravcomp="1"')]
)
def test_a_body_that_does_not_fall_passes(option, body, generator, tmp_path):
    (tmp_path / "body.xml").write_text(f"""<mujoco><option {option}/><worldbody>
      <body {body}><freejoint/><geom type="box" size=".1 .1 .1"/></body></worldbody>
      </mujoco>""")
    scene = Scene.from_mjcf(tmp_path / "body.xml")
    log = simulated(scene, generator)
    assert check_log(log, scene)
    fall = 0.5 * 9.81 * (torch.arange(20) * log.frame) ** 2
    qpos = log.qpos.clone()
    qpos[:, 2] -= fall.repeat(len(log))
    qvel = torch.full_like(log.qvel, float("nan"))
    with pytest.raises(ValueError, match="free fall along z"):
        check_log(replace(log, qpos=qpos, qvel=qvel), scene)
