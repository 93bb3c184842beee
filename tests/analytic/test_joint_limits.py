"""Soft joint limits: MuJoCo's own forces, whatever their springs and impedance."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
from helpers import make_scene, mujoco_step, random_transitions

from torchrl_nerd.analytic import joint_limits
from torchrl_nerd.analytic.unconstrained import UnconstrainedStep
from torchrl_nerd.keys import JOINT_TORQUE, QPOS, QVEL
from torchrl_nerd.robots import load_scene

ROWS = 64
CHAIN = """<mujoco><compiler autolimits="true"/><default><geom contype="0"/>
  <joint solreflimit="{solref}" solimplimit="{solimp}" margin="{margin}"/></default>
  <worldbody><body pos="0 0 1"><joint name="a" axis="1 2 3" range="-40 30"/>
    <geom type="capsule" size="0.05 0.2" pos="0.1 0 0"/>
    <body pos="0.3 0 0"><joint name="b" axis="1 2 3" range="-0.1 50" armature="0.01"/>
      <geom type="box" size="0.1 0.2 0.3" pos="0.1 0.1 0"/>
      <body pos="0 0 0.3"><joint name="c" axis="0 1 0"/><geom size="0.1" pos="0.1 0 0"/>
        <body pos="0.2 0 0"><joint name="d" type="slide" axis="0 1 1" range="-0.2 0.1"/>
          <geom size="0.1"/></body></body></body></body></worldbody>
  <actuator><motor joint="a"/><motor joint="b"/><motor joint="c"/><motor joint="d"/>
  </actuator></mujoco>"""
DEFAULT = {"solref": "0.02 1", "solimp": "0.9 0.95 0.001 0.5 2", "margin": "0"}
ENDS = {
    "MuJoCo's": {},
    "springs": {"solref": "-3000 -80", "solimp": "0.3 0.3 0.1 0.5 2"},
    "slow": {"solref": "0.3 0.2"},
    "too fast": {"solref": "1e-5 1"},
    "hardening": {"solimp": "0.1 0.9 0.3 0.2 3"},
    "bent late": {"solimp": "0.5 0.8 0.5 0.8 1.5"},
    "no width": {"solimp": "0.2 0.9 0 0.5 1"},
    "margin": {"margin": "0.05"},
}
LIMITED = [load_scene(name) for name in ("cartpole", "franka_gravity")]


def chain(control_step=0.002, substeps=1, **ends):
    """A hinge, two more about nearly the same axis, and a slide, all but one limited."""
    model = mujoco.MjModel.from_xml_string(CHAIN.format(**DEFAULT | ends))
    model.opt.timestep = control_step / substeps
    return replace(make_scene(model), substeps=substeps)


def random_rows(scene, generator):
    """States from half within to half beyond the limits, and torques."""
    rows = random_transitions(scene, ROWS, generator)
    low, high = torch.from_numpy(scene.model.jnt_range).T
    share = torch.rand(*rows[QPOS].shape, generator=generator, dtype=torch.float64)
    within = low + (2.0 * share - 0.5) * (high - low)
    rows[QPOS] = torch.where(low < high, within, rows[QPOS])
    return rows


def step(scene, rows):
    """Where a step leads."""
    return UnconstrainedStep(scene)(rows[QPOS], rows[QVEL], rows[JOINT_TORQUE])[:2]


@pytest.mark.parametrize("ends", ENDS)
def test_one_substep_is_that_of_mujoco(ends, generator, monkeypatch):
    """Where the iteration is let to end, to the rounding of MuJoCo's solver.

    Without dampers: MuJoCo brakes by them at a substep's end, when the ends have pushed.
    """
    monkeypatch.setattr(joint_limits, "NUM_SWEEPS", 3000)
    scene = chain(**ENDS[ends])
    rows = random_rows(scene, generator)
    want = mujoco_step(scene, rows, rows[JOINT_TORQUE])["next"]
    size = (want[QVEL] - rows[QVEL]).abs().amax()
    for got, key in zip(step(scene, rows), (QPOS, QVEL), strict=True):
        torch.testing.assert_close(got, want[key], rtol=0.0, atol=float(1e-5 * size))


@pytest.mark.parametrize("scene", LIMITED, ids=lambda scene: scene.name)
def test_a_control_step_is_near_that_of_mujoco(scene, generator):
    """Of joints beyond their ends, and a tenth of what leaving the ends out costs."""
    rows = random_rows(scene, generator)
    want = mujoco_step(scene, rows, rows[JOINT_TORQUE])["next"][QVEL]
    unlimited = UnconstrainedStep(scene)
    ends, unlimited.limits = unlimited.limits, None
    _, free, _ = unlimited(rows[QPOS], rows[QVEL], rows[JOINT_TORQUE])
    joints, (low, high) = rows[QPOS][:, ends.joints], ends.limits[..., 0]
    is_pushed = ((joints < low) | (joints > high)).any(-1)
    error, left_out = (
        (x - want)[is_pushed].norm(dim=-1) for x in (step(scene, rows)[1], free)
    )
    assert error.median() < 0.1 * left_out.median()
    assert error.median() < 0.15 * (want - rows[QVEL])[is_pushed].norm(dim=-1).median()


def test_no_end_pulls():
    """A joint that comes back faster than its end asks for is left alone."""
    scene = make_scene("""<mujoco><option gravity="0 0 0"/><compiler autolimits="true"/>
      <worldbody><body><joint type="slide" range="-1 2"/><geom size="0.1" contype="0"/>
      </body></worldbody></mujoco>""")
    qpos = torch.tensor([[-1.2], [-1.01], [2.01], [2.4]]).double()
    qvel = torch.tensor([[9.0], [0.6], [-0.7], [-20.0]]).double()
    after, rate, *_ = UnconstrainedStep(scene)(qpos, qvel, qpos[:, :0])
    torch.testing.assert_close(rate, qvel, rtol=1e-12, atol=0.0)
    torch.testing.assert_close(after, qpos + scene.control_step * qvel)
    after, rate, *_ = UnconstrainedStep(scene)(qpos, -qvel, qpos[:, :0])
    assert (rate.abs() < qvel.abs()).all()


def test_it_converges_however_joints_are_coupled(generator):
    """Jacobi's plain iteration throws this chain of four heavy links."""
    links, ends = "", ""
    for name in "abcd":
        links += f"""<body pos="2 0 0"><joint name="{name}" axis="0 0 1" range="-10 10"/>
          <geom size="0.5" pos="1 0 0"/>"""
        ends += "</body>"
    motors = "".join(f'<motor joint="{name}"/>' for name in "abcd")
    scene = make_scene(f"""<mujoco><compiler autolimits="true"/>
      <default><geom contype="0"/></default><worldbody>{links}{ends}</worldbody>
      <actuator>{motors}</actuator></mujoco>""")
    data, mass = mujoco.MjData(scene.model), np.zeros((4, 4))
    mujoco.mj_forward(scene.model, data)
    mujoco.mj_fullM(scene.model, data, mass)
    coupling = np.linalg.inv(mass)
    growth = np.linalg.eigvals(coupling / coupling.diagonal()[:, None]) - 1.0
    assert abs(growth).max() > 2.0  # of an error, in each of Jacobi's sweeps
    rows = random_rows(scene, generator)
    qpos, qvel = rows[QPOS], rows[QVEL]
    unconstrained = UnconstrainedStep(scene)
    for _ in range(100):
        qpos, qvel, *_ = unconstrained(qpos, qvel, 0.0 * qvel)
        assert qvel.abs().max() < 1e3
    assert (qpos.abs() < 1.0).all() and qvel.norm(dim=-1).median() < 20.0


def test_gradients_pass_through_an_end(generator):
    scene = chain(0.01, 5)
    rows = random_rows(scene, generator)[:4]
    torque = rows[JOINT_TORQUE].clone().requires_grad_()
    unconstrained = UnconstrainedStep(scene)

    def speed(torque):
        return unconstrained(rows[QPOS], rows[QVEL], torque)[1]

    assert torch.autograd.gradcheck(speed, (torque,), eps=1e-6, atol=1e-5)


@pytest.mark.parametrize("solref", ["-100000 -1", "-100000 -20", "0.2 0.02"])
def test_springs_that_are_hardly_damped_stay_bounded(solref):
    """A control step of twenty substeps, fifty times: as fast as in MuJoCo at most."""
    text = f'''<mujoco><option timestep="0.001" gravity="0 0 0"/><worldbody><body>
      <joint axis="0 1 0" limited="true" range="-10 10" solreflimit="{solref}"/>
      <geom size="0.1" pos="0.3 0 0" contype="0" mass="1"/></body></worldbody></mujoco>'''
    scene = replace(make_scene(text), substeps=20)
    limited = UnconstrainedStep(scene)
    qpos, qvel = torch.zeros(1, 1).double(), torch.ones(1, 1).double()
    speeds = []
    for _ in range(50):
        qpos, qvel, _ = limited(qpos, qvel)
        speeds.append(float(qvel.abs()))
    assert max(speeds) < 1.5
