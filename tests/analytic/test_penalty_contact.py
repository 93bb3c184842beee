"""A step along springs: MuJoCo's substeps, but for what changes between two looks."""

from dataclasses import replace

import mujoco
import pytest
import torch
from dynamics_helpers import GROUNDED, each_grounded
from helpers import (
    in_ground,
    make_scene,
    random_transitions,
    true_step,
    with_points_in_order,
)

from torchrl_nerd.geometry.manifold import differentiate_pos
from torchrl_nerd.keys import JOINT_TORQUE, QPOS, QVEL, TERRAIN
from torchrl_nerd.analytic.penalty_contact import PenaltyContactStep
from torchrl_nerd.robots import load_scene
from torchrl_nerd.scenes.penalty_law import set_penalty_contact

ROWS = 256
BALL = """<mujoco><option cone="{cone}" timestep="0.001"/><worldbody>
  <geom type="plane" size="1 1 1"/><body pos="0 0 0.2"><freejoint/>
  <geom size="0.1" density="200"/></body></worldbody></mujoco>"""


each_looks = pytest.mark.parametrize("looks", [1, 2, 3])
coarse_looks = pytest.mark.parametrize("looks", [1, 2])


def moved(scene, rows, looks=2, stride=1, parts=1, **how):
    """The step's next state of ``rows``."""
    inputs = rows[QPOS], rows[QVEL], rows[JOINT_TORQUE], rows.get(TERRAIN, None)
    return PenaltyContactStep(scene, looks, stride, parts)(*inputs, **how)


def errors(scene, rows, looks=2, parts=1):
    """Error of velocities and places, over the true change of velocity, of each row."""
    qpos, qvel, _ = moved(scene, rows, looks, parts=parts)
    truth = rows["next"]
    size = (truth[QVEL] - rows[QVEL]).norm(dim=-1).clamp_min(1e-6)
    fast = (qvel - truth[QVEL]).norm(dim=-1) / size
    slip = differentiate_pos(scene.layout, qpos, truth[QPOS]).norm(dim=-1)
    return fast, slip / (size * scene.control_step)


def teacher(scene, looks):
    """Whose next state that many looks lead to."""
    return scene.reference if looks == 3 else scene


def touching(scene, generator, looks=2):
    rows = in_ground(scene, ROWS, generator)
    torque = rows[JOINT_TORQUE]
    return true_step(teacher(scene, looks), rows.exclude("next"), torque)


def air(scene, generator):
    """Rows that neither ground nor limits push."""
    rows = random_transitions(scene, ROWS, generator)
    if scene.base.is_floating:
        rows[QPOS][:, 2] += 3.0
    else:
        rows[TERRAIN][:, 3] -= 10.0
    for joint in range(scene.model.njnt):
        if scene.model.jnt_limited[joint]:
            at = scene.model.jnt_qposadr[joint]
            rows[QPOS][:, at] = float(scene.model.jnt_range[joint].mean())
    rows[QVEL].mul_(0.3)
    rows[JOINT_TORQUE] = 0.01 * rows[JOINT_TORQUE]
    return true_step(scene, rows.exclude("next"), rows[JOINT_TORQUE])


@each_grounded
@coarse_looks
def test_one_substep_is_mujocos_as_its_constraints_get_soft(scene, looks, generator):
    """What the law leaves out is in proportion to their impedance."""
    model = scene.with_substeps(scene.substeps).model
    one, found = replace(scene, model=model, substeps=1), []
    many = 4 * ROWS  # of fewer the medians differ by half
    rows = in_ground(one, many, generator).exclude("next")
    torque = random_transitions(one, many, generator)[JOINT_TORQUE]
    for impedance in (1e-3, 1e-4):  # MuJoCo's least
        for solimp in (model.geom_solimp, model.jnt_solimp):
            solimp[:, :2] = impedance
        fast, slip = errors(one, true_step(one, rows, torque), looks)
        assert fast.median() < 20.0 * impedance and slip.median() < 20.0 * impedance
        found.append(fast.median())
    assert found[1] < 0.3 * found[0]  # a tenth, but for rows that lose touch


@each_grounded
@each_looks
def test_it_goes_where_mujoco_goes(scene, looks, generator):
    fast, slip = errors(scene, touching(scene, generator, looks), looks)
    most = {1: 0.25, 2: 0.05, 3: 0.05}[looks]
    assert fast.median() < most and slip.median() < most


@each_grounded
def test_a_second_look_sees_more(scene, generator):
    rows = touching(scene, generator)
    (once, _), (twice, _) = (errors(scene, rows, looks) for looks in (1, 2))
    assert twice.median() < once.median()


@each_grounded
def test_looks_in_every_part_see_more_still(scene, generator):
    rows = touching(scene, generator)
    parts = next(k for k in (2, 5) if scene.substeps % k == 0)
    (whole, _), (halves, _) = (errors(scene, rows, 2, n) for n in (1, parts))
    assert halves.median() < whole.median()


@each_grounded
def test_a_third_look_sees_what_the_finer_teacher_does(scene, generator):
    rows = touching(scene, generator, looks=3)
    (twice, _), (thrice, _) = (errors(scene, rows, looks) for looks in (2, 3))
    assert thrice.median() < 0.8 * twice.median()


@each_grounded
@each_looks
def test_substeps_at_once_are_longer_substeps(scene, looks, generator):
    rows = touching(scene, generator)
    stride = max(k for k in (2, 3, 5) if scene.substeps % k == 0)
    longer = scene.with_substeps(scene.substeps // stride)
    pairs = moved(scene, rows, looks, stride), moved(longer, rows, looks)
    for one, other in zip(*pairs, strict=True):
        torch.testing.assert_close(one, other)


@each_grounded
@each_looks
def test_parts_are_shorter_control_steps(scene, looks, generator):
    rows = touching(scene, generator, looks)
    parts = next(k for k in (2, 5) if scene.substeps % k == 0)
    shorter = replace(scene, substeps=scene.substeps // parts)
    now, wrong = rows, []
    for _ in range(parts):
        qpos, qvel, off = moved(shorter, now, looks)
        now = rows.clone().update({QPOS: qpos, QVEL: qvel})
        wrong.append(off)
    expected = qpos, qvel, torch.cat(wrong, -1)
    for one, other in zip(expected, moved(scene, rows, looks, 1, parts), strict=True):
        torch.testing.assert_close(other, one)


@each_grounded
@each_looks
def test_half_a_step_in_the_air_has_an_eighth_of_the_error(scene, looks, generator):
    """A quarter of it after a single look, a sixteenth of a velocity's after three."""
    rows, found = air(scene, generator), []
    for parts in (1, 2):
        model = scene.with_substeps(scene.substeps).model
        model.opt.timestep /= parts
        here = replace(scene, model=model)
        start = rows.exclude("next")
        truth = true_step(teacher(here, looks), start, rows[JOINT_TORQUE])
        fast, slip = errors(here, truth, looks)
        found.append((fast.median(), slip.median()))  # the fastest are far off
    less = {1: (1.5, 1.5), 2: (2.5, 2.5), 3: (5.0, 2.5)}[looks]
    for coarse, fine, times in zip(*found, less, strict=True):  # relative: over a half
        assert fine < max(coarse / times, 1e-7)


@each_grounded
def test_springs_are_as_good_in_float32(scene, generator):
    rows = touching(scene, generator)
    expected, got = moved(scene, rows), moved(scene, rows, dtype=torch.float32)
    size = (expected[1] - rows[QVEL]).norm(dim=-1)
    error = (got[1] - expected[1]).norm(dim=-1)
    assert (error < 1e-3 * (1.0 + size)).float().mean() > 0.97  # some lose touch by it
    assert got[0].dtype == got[1].dtype == torch.float64


@each_grounded
def test_any_batch_is_a_batch_of_rows(scene, generator):
    rows = touching(scene, generator)[:6]
    flat, square = moved(scene, rows), moved(scene, rows.reshape(2, 3))
    for one, other in zip(flat, square, strict=True):
        torch.testing.assert_close(other.flatten(0, 1), one)
    alone = moved(scene, rows[4:5])
    for one, other in zip(flat, alone, strict=True):
        torch.testing.assert_close(other[0], one[4], atol=1e-9, rtol=1e-9)


def test_it_has_gradients(generator):
    scene = load_scene("cube")
    rows = touching(scene, generator)[:8]
    step = PenaltyContactStep(scene)
    speed = rows[QVEL].clone().requires_grad_()
    (found,) = torch.autograd.grad(
        step(rows[QPOS], speed, speed[:, :0])[1].sum(), speed
    )
    assert found.isfinite().all()
    tiny, numeric = 1e-7, torch.zeros_like(found)
    with torch.no_grad():
        for k in range(speed.shape[1]):
            ends = []
            for sign in (1.0, -1.0):
                moving = speed.clone()
                moving[:, k] += sign * tiny
                ends.append(step(rows[QPOS], moving, speed[:, :0])[1].sum(-1))
            numeric[:, k] = (ends[0] - ends[1]) / (2.0 * tiny)
    close = (found - numeric).abs().amax(-1) < 1e-3 * (1.0 + numeric.abs().amax(-1))
    assert close.float().mean() > 0.7  # a row may lose touch just there


def ball(cone="elliptic"):
    model = mujoco.MjModel.from_xml_string(BALL.format(cone=cone))
    set_penalty_contact(model, ke=2e3, kd=20.0, kf=30.0, mu=0.5)
    return replace(make_scene(model), substeps=4)


def test_a_rolling_ball_is_turned_by_its_rim():
    """Friction acts where the ball touches, not at its centre: it spins up as it slides."""
    scene = ball()
    qpos = torch.tensor([[0.0, 0.0, 0.0995, 1.0, 0.0, 0.0, 0.0]]).double()
    qvel = torch.tensor([[1.0, 0.0, 0.0, 0.0, 0.0, 0.0]]).double()
    _, after, _ = PenaltyContactStep(scene)(qpos, qvel, qpos[:, :0])
    assert after[0, 0] < 1.0 and after[0, 4] > 0.0
    inertia = 0.4 * 0.1  # over m r: of a solid sphere
    torch.testing.assert_close(
        inertia * after[0, 4], 1.0 - after[0, 0], rtol=0.02, atol=0
    )


@pytest.mark.parametrize(
    ("scene", "sentence"),
    [
        (load_scene("franka"), "expected a ground to step on, got scene 'franka'"),
        (GROUNDED[0].reference, "expected substeps of mjINT_EULER, got mjINT_RK4"),
        (ball("pyramidal"), "expected elliptic friction cones, got pyramidal ones"),
    ],
)
def test_what_it_does_not_know_is_refused(scene, sentence):
    with pytest.raises(ValueError, match=sentence):
        PenaltyContactStep(scene)


def test_nobody_looks_four_times():
    with pytest.raises(ValueError, match="expected one look, two or three, got 4"):
        PenaltyContactStep(GROUNDED[0], looks=4)


@pytest.mark.parametrize("parts", [0, 3])
def test_parts_of_unlike_lengths_are_refused(parts):
    sentence = f"expected parts of equal numbers of substeps, got {parts} of 16"
    with pytest.raises(ValueError, match=sentence):
        PenaltyContactStep(load_scene("ant"), parts=parts)


def test_so_are_contacts_and_limits_of_another_law():
    with pytest.raises(ValueError, match="expected contacts that are springs"):
        PenaltyContactStep(make_scene(BALL.format(cone="elliptic")))
    scene = load_scene("ant")
    model = scene.with_substeps(scene.substeps).model
    model.jnt_solref[:] = (0.02, 1.0)
    with pytest.raises(ValueError, match="expected limits that are springs"):
        PenaltyContactStep(replace(scene, model=model))


@each_grounded
@each_looks
def test_points_in_another_order_push_alike(scene, looks, generator):
    rows = touching(scene, generator, looks)
    order = torch.randperm(len(scene.contacts), generator=generator)
    got = moved(with_points_in_order(scene, order), rows, looks)
    torch.testing.assert_close(got, moved(scene, rows, looks), rtol=1e-6, atol=1e-6)
