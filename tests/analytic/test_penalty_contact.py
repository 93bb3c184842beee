"""The penalty-contact step: MuJoCo's substeps, but for what is interpolated."""

from dataclasses import replace

import mujoco
import pytest
import torch
from helpers import (
    in_ground,
    make_scene,
    mujoco_step,
    random_transitions,
    with_points_in_order,
)

from torchrl_nerd.analytic.penalty_contact import PenaltyContactStep
from torchrl_nerd.geometry.manifold import differentiate_pos
from torchrl_nerd.keys import JOINT_TORQUE, QPOS, QVEL, TERRAIN
from torchrl_nerd.robots import load_scene
from torchrl_nerd.scenes.penalty_law import PenaltyLaw, set_penalty_contact

ROWS = 256
BALL = """<mujoco><option cone="{cone}" timestep="0.001"/><worldbody>
  <geom type="plane" size="1 1 1"/><body pos="0 0 0.2"><freejoint/>
  <geom size="0.1" density="200"/></body></worldbody></mujoco>"""


NAMES = "double_pendulum", "ant", "anymal", "cube", "cube_slope"
ON_GROUND = [load_scene(name) for name in NAMES]
each_on_ground = pytest.mark.parametrize(
    "scene", ON_GROUND, ids=lambda scene: scene.name
)
each_stages = pytest.mark.parametrize("stages", [1, 2])


def moved(scene, rows, stages=2, merged=1, outer=1, precision="float64"):
    """The step's next state of ``rows``, and its defect."""
    inputs = rows[QPOS], rows[QVEL], rows[JOINT_TORQUE], rows.get(TERRAIN, None)
    return PenaltyContactStep(scene, stages, outer, merged, precision)(*inputs)


def errors(scene, rows, stages=2, outer=1):
    """Error of velocities and places over the true change of velocity, per state."""
    qpos, qvel, _ = moved(scene, rows, stages, outer=outer)
    ground_truth = rows["next"]
    size = (ground_truth[QVEL] - rows[QVEL]).norm(dim=-1).clamp_min(1e-6)
    fast = (qvel - ground_truth[QVEL]).norm(dim=-1) / size
    slip = differentiate_pos(scene.layout, qpos, ground_truth[QPOS]).norm(dim=-1)
    return fast, slip / (size * scene.control_step)


def touching(scene, generator):
    rows = in_ground(scene, ROWS, generator)
    return mujoco_step(scene, rows.exclude("next"), rows[JOINT_TORQUE])


def air(scene, generator):
    """States that neither ground nor limits push."""
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
    return mujoco_step(scene, rows.exclude("next"), rows[JOINT_TORQUE])


@each_on_ground
@each_stages
def test_one_substep_is_mujocos_as_its_constraints_get_soft(scene, stages, generator):
    """What the law leaves out is in proportion to their impedance."""
    model = scene.with_substeps(scene.substeps).model
    one, found = replace(scene, model=model, substeps=1), []
    many = 4 * ROWS  # of fewer the medians differ by half
    rows = in_ground(one, many, generator).exclude("next")
    torque = random_transitions(one, many, generator)[JOINT_TORQUE]
    for impedance in (1e-3, 1e-4):  # MuJoCo's least
        for solimp in (model.geom_solimp, model.jnt_solimp):
            solimp[:, :2] = impedance
        fast, slip = errors(one, mujoco_step(one, rows, torque), stages)
        assert fast.median() < 20.0 * impedance and slip.median() < 20.0 * impedance
        found.append(fast.median())
    assert found[1] < 0.3 * found[0]  # a tenth, but for states that lose touch


@each_on_ground
@each_stages
def test_it_goes_where_mujoco_goes(scene, stages, generator):
    fast, slip = errors(scene, touching(scene, generator), stages)
    most = {1: 0.25, 2: 0.05}[stages]
    assert fast.median() < most and slip.median() < most


@each_on_ground
def test_two_stages_are_more_accurate_than_one(scene, generator):
    rows = touching(scene, generator)
    (once, _), (twice, _) = (errors(scene, rows, stages) for stages in (1, 2))
    assert twice.median() < once.median()


@each_on_ground
def test_two_outer_steps_are_more_accurate_still(scene, generator):
    rows = touching(scene, generator)
    outer = next(k for k in (2, 5) if scene.substeps % k == 0)
    (whole, _), (finer, _) = (errors(scene, rows, 2, n) for n in (1, outer))
    assert finer.median() < whole.median()


@each_on_ground
@each_stages
def test_merged_substeps_are_longer_substeps(scene, stages, generator):
    rows = touching(scene, generator)
    merged = max(k for k in (2, 3, 5) if scene.substeps % k == 0)
    longer = scene.with_substeps(scene.substeps // merged)
    pairs = moved(scene, rows, stages, merged), moved(longer, rows, stages)
    for one, other in zip(*pairs, strict=True):
        torch.testing.assert_close(one, other)


@each_on_ground
@each_stages
def test_outer_steps_are_shorter_control_steps(scene, stages, generator):
    rows = touching(scene, generator)
    outer = next(k for k in (2, 5) if scene.substeps % k == 0)
    shorter = replace(scene, substeps=scene.substeps // outer)
    now, defects = rows, []
    for _ in range(outer):
        qpos, qvel, defect = moved(shorter, now, stages)
        now = rows.clone().update({QPOS: qpos, QVEL: qvel})
        defects.append(defect)
    expected = qpos, qvel, torch.cat(defects, -1)
    for one, other in zip(expected, moved(scene, rows, stages, 1, outer), strict=True):
        torch.testing.assert_close(other, one)


@each_on_ground
@each_stages
def test_half_a_step_in_the_air_has_an_eighth_of_the_error(scene, stages, generator):
    """A quarter of it after a single look."""
    rows, found = air(scene, generator), []
    for shorter in (1, 2):
        model = scene.with_substeps(scene.substeps).model
        model.opt.timestep /= shorter
        here = replace(scene, model=model)
        start = rows.exclude("next")
        ground_truth = mujoco_step(here, start, rows[JOINT_TORQUE])
        fast, slip = errors(here, ground_truth, stages)
        found.append((fast.median(), slip.median()))  # the fastest are far off
    less = {1: (1.5, 1.5), 2: (2.5, 2.5)}[stages]
    for coarse, fine, times in zip(*found, less, strict=True):  # relative: over a half
        assert fine < max(coarse / times, 1e-7)


@each_on_ground
def test_springs_are_as_good_in_float32(scene, generator):
    rows = touching(scene, generator)
    expected, got = moved(scene, rows), moved(scene, rows, precision="float32")
    size = (expected[1] - rows[QVEL]).norm(dim=-1)
    error = (got[1] - expected[1]).norm(dim=-1)
    assert (error < 1e-3 * (1.0 + size)).float().mean() > 0.97  # some lose touch by it
    assert got[0].dtype == got[1].dtype == torch.float64


@each_on_ground
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
    step = PenaltyContactStep(scene, precision="float64")
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
    _, after, _ = PenaltyContactStep(scene, precision="float64")(
        qpos, qvel, qpos[:, :0]
    )
    assert after[0, 0] < 1.0 and after[0, 4] > 0.0
    inertia = 0.4 * 0.1  # over m r: of a solid sphere
    torch.testing.assert_close(
        inertia * after[0, 4], 1.0 - after[0, 0], rtol=0.02, atol=0
    )


@pytest.mark.parametrize(
    ("scene", "sentence"),
    [
        (load_scene("cartpole"), "expected a scene with a ground, got 'cartpole'"),
        (ON_GROUND[0].reference, "expected substeps of Euler, got RK4 in"),
        (
            ON_GROUND[0].with_substeps(1, mujoco.mjtIntegrator.mjINT_IMPLICITFAST),
            "expected substeps of Euler, got implicitfast in",
        ),
        (ball("pyramidal"), "expected elliptic friction cones, got pyramidal ones"),
    ],
)
def test_what_it_does_not_know_is_refused(scene, sentence):
    with pytest.raises(ValueError, match=sentence):
        PenaltyContactStep(scene, num_outer_steps=1)


def test_nobody_stages_four_times():
    with pytest.raises(ValueError, match="expected 1 or 2 stages, got 3"):
        PenaltyContactStep(ON_GROUND[0], num_stages=3)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"num_outer_steps": 3}, "outer steps that divide 16 substeps, got 3"),
        (
            {"num_outer_steps": 0},
            "num_outer_steps, a whole number of at least 1, got 0",
        ),
        ({"merged_substeps": -2}, "merged_substeps, a whole number of at least 1"),
    ],
)
def test_steps_that_cannot_be_are_refused(changes, said):
    with pytest.raises(ValueError, match=said):
        PenaltyContactStep(load_scene("ant"), **changes)


LAW = {"ke": 2e3, "kd": 20.0, "kf": 30.0, "mu": 0.5}


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('size="1 1 1"', 'size="1 1 1" margin="0.02"', "a margin or gap"),
        ("</worldbody>", "{}</worldbody>", "that the file overrides"),
        ("</worldbody>", "{}</worldbody>", "an exact inertia of constraints"),
        ('timestep="0.001"', 'timestep="0.001" noslip_iterations="5"', "without slip"),
        ('size="0.1"', 'size="0.1" adhesion="50"', "shapes that adhere"),
    ],
)
def test_contacts_that_mujoco_changes_are_refused(old, new, said):
    flag = "override" if "overrides" in said else "diagexact"
    option = f'<option><flag {flag}="enable"/></option>'
    text = BALL.format(cone="elliptic").replace(old, new.format(""), 1)
    if "{}" in new:
        text = text.replace("</mujoco>", f"{option}</mujoco>")
    model = mujoco.MjModel.from_xml_string(text)
    set_penalty_contact(model, **LAW)
    with pytest.raises(ValueError, match=said):
        PenaltyContactStep(make_scene(model), num_outer_steps=1)


def test_an_impedance_that_grows_is_no_spring():
    model = ball().model
    model.geom_solimp[:, :2] = 1e-3, 1e-2
    with pytest.raises(ValueError, match="an impedance"):
        PenaltyContactStep(make_scene(model), num_outer_steps=1)


MEETING = """<mujoco><option cone="elliptic" timestep="0.001"/><worldbody>
  <geom type="plane" size="1 1 1"/><body pos="0 0 0.1"><joint axis="0 1 0"/>
  <geom type="capsule" size="0.05" fromto="0 0 0 0.5 0 0" {first}/>
  <body pos="0.5 0 0"><joint axis="0 1 0"/>
  <geom type="capsule" size="0.05" fromto="0 0 0 0.5 0 0" {second}/></body></body>
  </worldbody></mujoco>"""


def test_points_that_meet_have_one_law():
    """Where two links meet, MuJoCo has a contact of each."""
    scenes = []
    for ratio in (1.0, 2.0):
        model = mujoco.MjModel.from_xml_string(MEETING.format(first="", second=""))
        set_penalty_contact(model, **LAW)
        model.geom_solref[2] *= ratio
        scenes.append(make_scene(model))
    PenaltyContactStep(scenes[0], num_outer_steps=1)
    with pytest.raises(ValueError, match="one contact law of shapes that meet"):
        PenaltyContactStep(scenes[1], num_outer_steps=1)


def test_so_are_contacts_and_limits_of_another_law():
    with pytest.raises(ValueError, match="expected contacts that are springs"):
        PenaltyContactStep(make_scene(BALL.format(cone="elliptic")))
    scene = load_scene("ant")
    model = scene.with_substeps(scene.substeps).model
    model.jnt_solref[:] = (0.02, 1.0)
    with pytest.raises(ValueError, match="expected limits that are springs"):
        PenaltyContactStep(replace(scene, model=model))


@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        ("geom_solimp", (0.9, 0.95, 0.001, 0.5, 2.0), "with an impedance"),
        ("geom_margin", 0.01, "with a margin or gap"),
        ("geom_condim", 1, "with a condim other than 3"),
        ("geom_priority", 0, "with the ground's priority"),
        ("jnt_margin", 0.1, "limits that are springs .* with a margin or an imp"),
        ("jnt_solimp", (0.9, 0.95, 0.001, 0.5, 2.0), "limits that are springs"),
    ],
)
def test_all_that_makes_it_another_law_is_named(field, value, said):
    scene = load_scene("ant")
    model = scene.with_substeps(scene.substeps).model
    getattr(model, field)[:] = value
    with pytest.raises(ValueError, match=said):
        PenaltyContactStep(replace(scene, model=model))


def test_the_law_is_that_of_the_shapes_that_touch():
    """A shape that is only seen has no say; two that touch have to agree."""
    plain = """<mujoco><option cone="elliptic" timestep="0.001"/><worldbody>
      <geom type="plane" size="1 1 1"/><body pos="0 0 0.2"><freejoint/>{}
      <geom size="0.1" pos="{} 0 0" density="200"/></body></worldbody></mujoco>"""
    seen = '<geom size="0.02" contype="0" conaffinity="0" mass="0"/>'
    both = '<geom size="0.1" pos="0.3 0 0" density="200"/>'
    laws = []
    for text in ("", seen, both):
        scene = make_scene(plain.format(text, -0.3 if text == both else 0.0))
        set_penalty_contact(scene.model, ke=1e4, kd=100.0, kf=100.0, mu=0.5)
        if text:
            scene.model.geom_friction[1, 0] = 0.01
        if text == both:
            with pytest.raises(ValueError, match="shapes of one body that differ"):
                PenaltyContactStep(scene, num_outer_steps=1)
            continue
        PenaltyContactStep(scene, num_outer_steps=1)
        laws.append(PenaltyLaw.of_bodies(scene.model, [1]))
    assert laws[0].friction == laws[1].friction == 0.5


@each_on_ground
@each_stages
def test_points_in_another_order_push_alike(scene, stages, generator):
    rows = touching(scene, generator)
    order = torch.randperm(len(scene.contacts), generator=generator)
    got = moved(with_points_in_order(scene, order), rows, stages)
    torch.testing.assert_close(got, moved(scene, rows, stages), rtol=1e-6, atol=1e-6)
