"""A step along the free motion: MuJoCo's own, but for an error of third order."""

from dataclasses import replace

import mujoco
import pytest
import torch
from dynamics_helpers import FREE, each_free
from helpers import HANDMADE, make_scene, random_transitions, true_step

from torchrl_nerd.keys import JOINT_TORQUE, QPOS, QVEL
from torchrl_nerd.modules.correction import FreeConfig
from torchrl_nerd.modules.free import FreeNeRD
from torchrl_nerd.analytic.unconstrained import UnconstrainedStep
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
    after = true_step(scene, rows.exclude("next"), rows[JOINT_TORQUE])["next"]
    change, start = StateDelta(scene).delta, (rows[QPOS], rows[QVEL])
    want = change(*start, after[QPOS], after[QVEL])
    got = change(*start, *UnconstrainedStep(scene)(*start, rows[JOINT_TORQUE])[:2])
    return (got - want).chunk(2, -1), want.chunk(2, -1)


def test_the_paper_arm_is_free():
    assert "franka" in [scene.name for scene in FREE]


@each_free
def test_it_goes_where_mujoco_goes(scene, generator):
    rows = random_transitions(scene, 1000, generator)
    (fast, moved), (change, residual) = errors(scene, rows)
    for error, size, share in ((fast, change, 5e-3), (moved, residual, 0.5)):
        shares = error.norm(dim=-1) / size.norm(dim=-1)
        assert shares.median() < share
    slip = moved.norm(dim=-1) / (scene.control_step * change.norm(dim=-1))
    assert slip.median() < 0.02


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
    if substeps == 1 and integrator != "RK4":  # one look is all there is: it is exact
        assert found[0][0] < 1e-9 or integrator != "Euler"
        return
    for coarse, fine in zip(*found, strict=True):
        assert fine < coarse / 6.0


def test_strong_damping_does_not_throw_it(generator):
    """A hundred times what a step of MuJoCo's explicit damping could bear."""
    scene = chain("Euler", 0.02, 4)
    scene.model.dof_damping[:] = 1e4
    rows = random_transitions(scene, ROWS, generator)
    _, after, *_ = UnconstrainedStep(scene)(rows[QPOS], rows[QVEL], rows[JOINT_TORQUE])
    assert (after.abs().amax(-1) < rows[QVEL].abs().amax(-1) + 0.1).all()


def test_doubt_is_what_the_second_look_changed(generator):
    """None where acceleration is constant, some where it is not."""
    falling = make_scene("""<mujoco><worldbody><body><joint type="slide" axis="0 0 1"/>
      <geom size="0.1" contype="0"/></body></worldbody></mujoco>""")
    qpos, qvel = torch.zeros(5, 1).double(), torch.randn(5, 1).double()
    _, after, doubt, _ = UnconstrainedStep(falling)(qpos, qvel, qpos[:, :0])
    torch.testing.assert_close(after, qvel - 9.81 * falling.control_step)
    assert doubt.abs().max() < 1e-14
    scene = chain("Euler", 0.02, 4)
    rows = random_transitions(scene, ROWS, generator)
    *_, doubt, _ = UnconstrainedStep(scene)(rows[QPOS], rows[QVEL], rows[JOINT_TORQUE])
    assert (doubt.abs().amax(-1) > 0.0).all()


def test_how_far_beyond_a_limit_it_begins_or_ends():
    sliding = make_scene(
        """<mujoco><option gravity="0 0 0"/><worldbody><body><joint
      type="slide" range="-1 2"/><geom size="0.1" contype="0"/></body></worldbody></mujoco>
      """.replace("<option", '<compiler autolimits="true"/><option')
    )
    speed = 0.1 / sliding.control_step
    qpos = torch.tensor([[0.0], [1.95], [2.05], [-0.95], [-1.3], [1.5]]).double()
    qvel = speed * torch.tensor([[1.0], [1.0], [-1.0], [-1.0], [1.0], [1.0]]).double()
    after, *_, beyond = UnconstrainedStep(sliding)(qpos, qvel, qpos[:, :0])
    assert 2.0 < after[1] < 2.05 and -1.05 < after[3] < -1.0  # the end pushes
    ends = torch.stack((after[1] - 2.0, -1.0 - after[3]))
    want = torch.tensor([[0.0], [0.0], [0.05], [0.0], [0.3], [0.0]]).double()
    want[[1, 3]] = ends
    torch.testing.assert_close(beyond, want)


REFUSED = {
    "a ground": load_scene("double_pendulum"),
    "a floating base": HANDMADE["floater"],
    "air or water": load_scene("gymnasium/Swimmer-v5"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_else_moves_a_robot_is_refused(what):
    with pytest.raises(ValueError, match=f"alone move, got scene .* with .*{what}"):
        FreeNeRD(REFUSED[what], FreeConfig())
    if what == "air or water":
        with pytest.raises(ValueError, match=f"alone move, got scene .* with .*{what}"):
            UnconstrainedStep(REFUSED[what])


@pytest.mark.parametrize(
    ("what", "field"),
    [
        ("dry friction", "dof_frictionloss"),
        ("gravity compensation", "body_gravcomp"),
        ("parts that touch each other", "geom_contype"),
    ],
)
def test_so_is_what_no_motion_shows(what, field):
    scene = chain("Euler", 0.02, 2)
    UnconstrainedStep(scene)
    getattr(scene.model, field)[:] = 1
    with pytest.raises(ValueError, match=what):
        UnconstrainedStep(scene)
