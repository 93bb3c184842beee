"""The unconstrained step: MuJoCo's own, but for an error of third order."""

from dataclasses import replace

import mujoco
import pytest
import torch
from helpers import make_scene, mujoco_step, random_transitions

from torchrl_nerd.analytic.unconstrained import UnconstrainedStep
from torchrl_nerd.evaluation.explain import explain
from torchrl_nerd.keys import JOINT_TORQUE, QPOS, QVEL
from torchrl_nerd.robots import load_scene
from torchrl_nerd.transforms import StateDelta

ROWS = 64
CHAIN = """<mujoco><option gravity="1 -2 -9" integrator="{integrator}"/>
  <default><geom contype="0"/></default><worldbody>
  <body pos="0.1 0.2 1" euler="20 30 40"><joint name="a" axis="1 2 3" damping="0.7"
    pos="0.1 0.1 0.2" stiffness="3" springref="0.2" armature="0.1"/>
    <inertial pos="0.1 -0.1 0.2" mass="2" fullinertia="0.2 0.3 0.25 0.02 0.03 -0.04"/>
    <geom size="0.1"/>
    <body pos="0.3 0 0" euler="10 0 50"><joint name="b" type="slide" axis="0 1 1"
      damping="0.2"/><geom type="box" size="0.1 0.2 0.3" pos="0.1 0.1 0"/>
      <body pos="0 0 0.3"><joint name="c" axis="0 1 0" damping="0.1"/>
        <geom type="capsule" size="0.05 0.2" pos="0.1 0 0"/></body></body></body>
  </worldbody><actuator><motor joint="a"/><motor joint="b"/><motor joint="c"/></actuator>
  </mujoco>"""
INTEGRATORS = "Euler", "implicitfast", "RK4"


def chain(integrator, control_step, substeps):
    """Three joints with everything that moves a robot that nothing touches."""
    model = mujoco.MjModel.from_xml_string(CHAIN.format(integrator=integrator))
    model.opt.timestep = control_step / substeps
    return replace(make_scene(model), substeps=substeps)


def errors(scene, rows):
    """Of velocities' and positions' changes ``(rows, nv)``, and the changes' sizes."""
    after = mujoco_step(scene, rows.exclude("next"), rows[JOINT_TORQUE])["next"]
    change, start = StateDelta(scene).delta, (rows[QPOS], rows[QVEL])
    want = change(*start, after[QPOS], after[QVEL])
    got = change(*start, *UnconstrainedStep(scene)(*start, rows[JOINT_TORQUE])[:2])
    return (got - want).chunk(2, -1), want.chunk(2, -1)


@pytest.mark.parametrize("name", ["cartpole", "franka", "franka_gravity"])
def test_it_goes_where_mujoco_goes(name, generator):
    scene = load_scene(name)
    rows = random_transitions(scene, 1000, generator)
    (fast, moved), (change, residual) = errors(scene, rows)
    for error, size, share in ((fast, change, 5e-3), (moved, residual, 0.5)):
        shares = error.norm(dim=-1) / size.norm(dim=-1)
        assert shares.median() < share
    slip = moved.norm(dim=-1) / (scene.control_step * change.norm(dim=-1))
    assert slip.median() < 0.02


FLOATING = """<mujoco><option timestep="0.001"/><default><geom contype="0"
  conaffinity="0"/></default><worldbody><body pos="0 0 1">
  <joint type="free" damping="{damping}" armature="0.1"/>
  <geom type="box" size="0.1 0.2 0.3" mass="1"/><body pos="0.1 0 0.3">
  <joint name="a" axis="0 1 0" damping="0.01"/>
  <geom type="capsule" fromto="0 0 0 0 0 0.3" size="0.03" mass="0.3"/></body></body>
  </worldbody><actuator><motor joint="a"/></actuator></mujoco>"""


@pytest.mark.parametrize("damping", [0.0, 0.5, 2.0])
def test_a_damped_base_slows_as_in_mujoco(damping, generator):
    scene = replace(make_scene(FLOATING.format(damping=damping)), substeps=10)
    rows = random_transitions(scene, ROWS, generator)
    (fast, _), (change, _) = errors(scene, rows)
    assert (fast.norm(dim=-1) / change.norm(dim=-1)).max() < 0.01


def test_soft_limits_leave_the_midpoint_rule_alone(generator):
    """Where one solve is enough, the second evaluation is still that of the middle."""
    text = CHAIN.format(integrator="Euler")
    limit = ' range="-9999 9999" limited="true" solreflimit="0.3 1"'
    soft = text.replace('axis="1 2 3"', f'axis="1 2 3"{limit}')
    free, limited = (
        replace(
            make_scene(xml.replace("<option", '<option timestep="0.002"')), substeps=5
        )
        for xml in (text, soft)
    )
    assert UnconstrainedStep(limited).num_solves == 1
    rows = random_transitions(free, ROWS, generator)
    start = rows[QPOS], rows[QVEL], rows[JOINT_TORQUE]
    expected, found = (
        UnconstrainedStep(free)(*start),
        UnconstrainedStep(limited)(*start),
    )
    for one, other in zip(expected, found, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("substeps", [1, 2, 7])
@pytest.mark.parametrize("integrator", INTEGRATORS)  # "implicit" takes Coriolis so, too
def test_half_a_step_has_an_eighth_of_the_error(integrator, substeps, generator):
    """Local error of third order, of MuJoCo's substeps as they are, not of their limit."""
    found = []
    for step in (0.02, 0.01):
        scene = chain(integrator, step, substeps)
        if not found:
            rows = random_transitions(scene, ROWS, generator)
        (fast, moved), (change, _) = errors(scene, rows)
        assert fast.norm() < 0.05 * change.norm()
        found.append((fast.norm(), moved.norm()))
    if substeps == 1 and integrator == "Euler":  # one evaluation is all there is
        assert max(*found[0], *found[1]) < 1e-9
        return
    if substeps == 1 and integrator == "implicitfast":  # whose damping is its own
        assert found[1][0] < found[0][0]
        return
    for coarse, fine in zip(*found, strict=True):
        assert fine < coarse / 6.0


def test_strong_damping_does_not_throw_it(generator):
    """A hundred times what a step of MuJoCo's explicit damping could bear."""
    scene = chain("Euler", 0.02, 4)
    scene.model.dof_damping[:] = 1e4
    rows = random_transitions(scene, ROWS, generator)
    _, after, _ = UnconstrainedStep(scene)(rows[QPOS], rows[QVEL], rows[JOINT_TORQUE])
    assert (after.abs().amax(-1) < rows[QVEL].abs().amax(-1) + 0.1).all()


def test_the_defect_is_what_the_second_evaluation_changed(generator):
    """None where acceleration is constant, some where it is not."""
    falling = make_scene("""<mujoco><worldbody><body><joint type="slide" axis="0 0 1"/>
      <geom size="0.1" contype="0"/></body></worldbody></mujoco>""")
    qpos, qvel = torch.zeros(5, 1).double(), torch.randn(5, 1).double()
    _, after, defect = UnconstrainedStep(falling)(qpos, qvel, qpos[:, :0])
    torch.testing.assert_close(after, qvel - 9.81 * falling.control_step)
    assert defect.abs().max() < 1e-14
    scene = chain("Euler", 0.02, 4)
    rows = random_transitions(scene, ROWS, generator)
    *_, defect = UnconstrainedStep(scene)(rows[QPOS], rows[QVEL], rows[JOINT_TORQUE])
    assert defect.shape[-1] == scene.layout.nv
    assert (defect.abs().amax(-1) > 0.0).all()


def test_air_and_water_are_refused():
    with pytest.raises(ValueError, match="alone, got scene .* with air or water"):
        UnconstrainedStep(load_scene("gymnasium/Swimmer-v5"))


@pytest.mark.parametrize(
    ("what", "field"),
    [
        ("dry friction", "dof_frictionloss"),
        ("gravity compensation", "body_gravcomp"),
        ("self-contact", "geom_contype"),
    ],
)
def test_forces_that_it_does_not_model_are_refused(what, field):
    scene = chain("Euler", 0.02, 2)
    UnconstrainedStep(scene)
    getattr(scene.model, field)[:] = 1
    with pytest.raises(ValueError, match=what):
        UnconstrainedStep(scene)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (
            "<option",
            '<option><flag gravity="disable"/></option><option',
            "switched off",
        ),
        ("<option", '<option><flag spring="disable"/></option><option', "switched off"),
        ("<option", '<option><flag limit="disable"/></option><option', "switched off"),
        (
            "<option",
            '<option><flag eulerdamp="disable"/></option><option',
            "switched off",
        ),
        ('stiffness="3"', 'stiffness="3 1"', "that grows"),
        ('damping="0.2"', 'damping="0.2 0.1"', "that grows"),
    ],
)
def test_forces_that_it_does_not_have_are_refused(old, new, said):
    text = CHAIN.format(integrator="Euler").replace(old, new, 1)
    with pytest.raises(ValueError, match=said):
        UnconstrainedStep(make_scene(text))


OBSTACLE = """<mujoco><worldbody><geom type="sphere" size="0.1" pos="0.3 0 0.5"/>
  <body pos="0 0 1"><joint axis="0 1 0"/><geom type="capsule" size="0.04"
  fromto="0 0 0 -0.6 0 0"/></body>{more}</worldbody></mujoco>"""


def test_an_obstacle_that_no_step_sees_is_refused_and_named():
    scene = make_scene(OBSTACLE.format(more=""))
    with pytest.raises(ValueError, match="with obstacles but planes, boxes and height"):
        UnconstrainedStep(scene)
    assert "shapes that no feature shows" in str(explain(scene))


def test_what_is_moved_by_hand_is_no_part_of_the_robot(generator):
    """A target to look at changes nothing, whatever it weighs."""
    untouched = 'contype="0" conaffinity="0"'
    hand = f'<body mocap="true"><geom size="0.05" {untouched} {{weight}}/></body>'
    free = OBSTACLE.replace('<geom type="sphere"', f"<geom {untouched}")
    scenes = [
        make_scene(free.format(more=hand.format(weight=weight)))
        for weight in ('mass="0"', 'mass="5"')
    ]
    rows = random_transitions(scenes[0], ROWS, generator)
    given = rows[QPOS], rows[QVEL], rows[JOINT_TORQUE]
    light, heavy = (UnconstrainedStep(scene)(*given) for scene in scenes)
    assert torch.equal(light.qvel, heavy.qvel) and light.qvel.isfinite().all()
