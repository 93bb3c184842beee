"""Unconstrained motion: what MuJoCo's own mass matrix and bias forces say."""

import copy

import mujoco
import numpy as np
import pytest
import torch
from helpers import make_scene, random_transitions

from torchrl_nerd.geometry.base import JointAxes
from torchrl_nerd.geometry.kinematics import PointKinematics
from torchrl_nerd.geometry.rigid_body import RigidBodyDynamics
from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.robots import SCENES, load_scene

ROWS = 16
BRANCHED = """<mujoco><option gravity="1 -2 -9"/><worldbody>
  <body pos="0.1 0.2 1" euler="20 30 40"><joint type="{first}" axis="1 2 3"
    pos="0.1 0.1 0.2" damping="0.7" stiffness="3" springref="0.2" armature="0.1"/>
    <inertial pos="0.1 -0.1 0.2" mass="2" fullinertia="0.2 0.3 0.25 0.02 0.03 -0.04"/>
    <geom size="0.1" pos="0 0 -0.2"/>
    <body pos="0.3 0 0" euler="10 0 50"><joint type="slide" axis="0 1 1" pos="0.1 0 0"/>
      <geom type="box" size="0.1 0.2 0.3" pos="0.1 0.1 0" euler="5 6 7"/>
      <body pos="0 0 0.3"><geom type="capsule" size="0.05 0.2"/></body></body>
    <body pos="-0.3 0 0"><joint axis="1 0 1" pos="0 0.1 0"/><geom size="0.1"
      pos="0.2 0 0"/></body></body></worldbody></mujoco>"""
SUPPORTED = [load_scene(name) for name in SCENES]
SUPPORTED += [make_scene(BRANCHED.format(first=kind)) for kind in ("hinge", "slide")]
floating = BRANCHED.replace('axis="1 2 3"\n', "").replace("{first}", "free")
floating = floating.replace('pos="0.1 0.1 0.2" damping="0.7" stiffness="3" ', "")
floating = floating.replace('springref="0.2" armature="0.1"', "")
SUPPORTED.append(make_scene(floating))


def free_acceleration(scene, rows, period=0.0, torque=None):
    model = scene.model
    axes = JointAxes.of(model, scene.base)
    motion = RigidBodyDynamics(model, scene.base, axes, list(range(model.nv)))
    points = motion.bodies, motion.positions
    places, _ = PointKinematics(model, scene.base, *points)(rows[QPOS], rows[QVEL][:0])
    rotation = scene.base_pose(rows[QPOS])[1]
    return motion(rows[QPOS], rows[QVEL], torque, rotation, places, period)


def mujoco_acceleration(scene, rows, period=0.0, torque=None):
    """Solved with the mass matrix and the bias of MuJoCo, nothing touching."""
    model = copy.copy(scene.model)
    data, found = mujoco.MjData(model), []
    matrix = np.zeros((model.nv, model.nv))
    pushes = [0.0] * len(rows) if torque is None else torque.numpy()
    for row, push in zip(rows, pushes, strict=True):
        mujoco.mj_resetData(model, data)
        data.qpos, data.qvel = row[QPOS].numpy(), row[QVEL].numpy()
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, matrix)
        force = data.qfrc_passive - data.qfrc_bias + push
        braked = matrix + 0.5 * period * np.diag(model.dof_damping)
        found.append(np.linalg.solve(braked, force))
    return torch.from_numpy(np.array(found))


@pytest.mark.parametrize("is_driven", [False, True])
@pytest.mark.parametrize("period", [0.0, 0.1])
@pytest.mark.parametrize("scene", SUPPORTED, ids=lambda scene: scene.name)
def test_it_is_mujocos_own(scene, period, is_driven, generator):
    rows, torque = random_transitions(scene, ROWS, generator), None
    if is_driven:
        torque = torch.randn(ROWS, scene.model.nv, generator=generator).double()
        torque[:, : 6 * scene.base.is_floating] = 0.0  # no motor moves a free base
    want = mujoco_acceleration(scene, rows, period, torque)
    got = free_acceleration(scene, rows, period, torque)
    scale = want.abs().amax(-1, keepdim=True) + 1.0
    assert ((got - want).abs() / scale).max() < 1e-9


def test_other_joints_are_refused():
    ball = make_scene("""<mujoco><worldbody><body><joint type="ball"/><geom size="1"/>
      </body></worldbody></mujoco>""")
    with pytest.raises(ValueError, match="one to a body, for the equation of motion"):
        JointAxes.of(ball.model, ball.base)


def test_inertia_without_mass_is_refused():
    """MuJoCo compiles it where the body is welded to one with mass."""
    shell = '<body><inertial pos="0 0 0" mass="0" diaginertia="0.5 0.5 0.5"/></body>'
    text = BRANCHED.format(first="hinge").replace("</body>", f"{shell}</body>", 1)
    scene = make_scene(text)
    axes = JointAxes.of(scene.model, scene.base)
    with pytest.raises(ValueError, match="expected mass where there is inertia"):
        RigidBodyDynamics(scene.model, scene.base, axes, scene.actuated)
