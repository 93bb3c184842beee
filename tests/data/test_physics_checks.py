"""Logs in wrong units or frames are refused by the physics check that they fail."""

from dataclasses import replace

import pytest
import torch

from torchrl_nerd.data.physics_checks import check_log
from torchrl_nerd.geometry.rotations import quat_multiply, rotate

XYZW = [1, 2, 3, 0]


def without(log, row: int, count: int, **changes):
    """The log with ``count`` frames lost from ``row`` on."""
    index = torch.arange(len(log.position))
    keep = (index < row) | (index >= row + count)
    offsets = log.offsets - count * (log.offsets > row).long()
    names = ("position", "quaternion", "linear", "angular")
    kept = {name: getattr(log, name)[keep] for name in names}
    return replace(log, **{**kept, "offsets": offsets, **changes})


def test_real_tosses_pass_with_all_that_was_asked(log, real_cube):
    checks = check_log(log, real_cube)
    assert len(checks) == 7 and all(check.passes for check in checks)


def test_where_they_are_and_face_does_not_matter(log, real_cube, generator):
    angle, shift = torch.randn(2, generator=generator).double()
    turn = torch.stack(((0.5 * angle).cos(), *angle.new_zeros(2), (0.5 * angle).sin()))
    turn = turn.expand(len(log.position), 4)
    move = torch.stack((shift, -2.0 * shift, 0.0 * shift))
    moved = replace(
        log,
        position=rotate(turn, log.position) + move,
        quaternion=quat_multiply(turn, log.quaternion),
        linear=rotate(turn, log.linear),
    )
    assert len(check_log(moved, real_cube)) == 7


def test_poses_alone_pass(log, real_cube):
    check_log(replace(log, linear=None, angular=None), real_cube)


WRONG = {
    "half widths": (
        lambda g: replace(g, position=g.position / 0.0524, linear=g.linear / 0.0524),
        ("free fall", "-18"),
    ),
    "millimetres": (
        lambda g: replace(g, position=1e3 * g.position, linear=1e3 * g.linear),
        ("free fall", "multiplied by about 0.001"),
    ),
    "y up": (
        lambda g: replace(g, position=g.position[:, [0, 2, 1]]),
        ("free fall", "y axis falls"),
    ),
    "z down": (
        lambda g: replace(g, position=-g.position, linear=-g.linear),
        ("free fall", "z points down"),
    ),
    "xyzw": (
        lambda g: replace(g, quaternion=g.quaternion[:, XYZW]),
        ("under the ground", "read as xyzw"),
    ),
    "xyzw, poses alone": (
        lambda g: replace(
            g, quaternion=g.quaternion[:, XYZW], linear=None, angular=None
        ),
        ("under the ground", "read as xyzw"),
    ),
    "angular velocity in world axes": (
        lambda g: replace(g, angular=rotate(g.quaternion, g.angular)),
        ("angular velocity in body axes", "world axes"),
    ),
    "degrees": (
        lambda g: replace(g, angular=torch.rad2deg(g.angular)),
        ("angular velocity", "degrees"),
    ),
    "linear velocity in body axes": (
        lambda g: replace(
            g, linear=rotate(g.quaternion * torch.tensor([1.0, -1, -1, -1]), g.linear)
        ),
        ("linear velocity", "body axes"),
    ),
    "not unit": (
        lambda g: replace(g, quaternion=1.1 * g.quaternion),
        ("length of quaternions", "0.1"),
    ),
    "another frame rate": (
        lambda g: replace(g, time=torch.arange(len(g.position)).double() / 100.0),
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
    apart = log.position[rows + count] - log.position[rows - 1]
    rows = rows[torch.linalg.vector_norm(apart, dim=-1) > 0.01]
    row = int(rows[torch.randint(len(rows), (), generator=generator)])
    spoilt = [without(log, row, count)]
    if count > 1:  # one frame of an impact: poses alone do not tell
        spoilt.append(without(log, row, count, linear=None, angular=None))
    for wrong in spoilt:
        with pytest.raises(ValueError, match="lost, before row"):
            check_log(wrong, real_cube)


def test_a_gap_between_time_stamps_is_found(log, real_cube):
    time = torch.arange(len(log.position)).double() / 148.0
    check_log(replace(log, time=time), real_cube)
    time[40:] += 0.05
    with pytest.raises(ValueError, match="gap in time"):
        check_log(replace(log, time=time), real_cube)
