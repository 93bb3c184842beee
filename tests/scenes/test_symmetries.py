"""Dropped coordinates do not matter to MuJoCo, and kept ones do."""

import mujoco
import pytest
import torch
from helpers import (
    every_scene,
    make_scene,
    mujoco_step,
    random_transitions,
)

from torchrl_nerd.geometry.manifold import HINGE, SLIDE
from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.robots import load_scene
from torchrl_nerd.scenes.symmetries import periodic_hinges
from torchrl_nerd.transforms import StateDelta

ROWS = 100
RAIL = """
<mujoco><option gravity="{gravity}"/><worldbody><body>
  <joint name="a" type="{kind}" axis="{axis}" {extra}/>
  <geom pos="0.1 0 0" size="0.1"/><body pos="0.3 0 0">
  <joint name="b" axis="0 1 0" damping="0.1"/><geom pos="0.2 0 0.1" size="0.1"/></body>
</body></worldbody></mujoco>"""


def change_of(scene, steps):
    """The true target: the change of state over one control step."""
    after = steps["next"]
    target = StateDelta(scene).delta
    return target(steps[QPOS], steps[QVEL], after[QPOS], after[QVEL])


def redrawn(scene, steps, key, address, generator):
    """One coordinate drawn anew, well inside its limits, and one MuJoCo step from there."""
    moved = steps.exclude("next").clone()
    draw = torch.rand(len(steps), dtype=torch.float64, generator=generator)
    value = 4.0 * draw - 2.0
    if key == QPOS:
        joint = list(scene.model.jnt_qposadr).index(address)
        if scene.model.jnt_limited[joint]:
            low, high = scene.model.jnt_range[joint]
            value = low + (0.2 + 0.6 * draw) * (high - low)
    moved[key][:, address] = value
    return mujoco_step(scene, moved, steps["next", "joint_torque"])


def scalar_joints(scene):
    """Addresses (qpos, dof) of hinges and slides."""
    model = scene.model
    kinds = {j: int(model.jnt_type[j]) for j in range(model.njnt)}
    scalar = [j for j, kind in kinds.items() if kind in (HINGE, SLIDE)]
    return [(int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j])) for j in scalar]


@every_scene
def test_a_coordinate_is_dropped_exactly_when_steps_ignore_it(scene, generator):
    drawn = random_transitions(scene, ROWS, generator)
    found = {QPOS: scene.symmetries.positions, QVEL: scene.symmetries.velocities}
    for addresses in scalar_joints(scene):
        for key, address in zip((QPOS, QVEL), addresses, strict=True):
            steps = redrawn(
                scene, drawn, QPOS, addresses[0], generator
            )  # no limit near
            moved = redrawn(scene, steps, key, address, generator)
            before, after = change_of(scene, steps), change_of(scene, moved)
            difference = (after - before).abs().max() / before.abs().max()
            if address in found[key]:
                assert difference < 1e-9, f"{key}[{address}] matters"
            else:
                assert difference > 1e-6, f"{key}[{address}] does not matter"


def test_cartpole_ignores_where_it_is_and_how_fast_it_rolls():
    symmetries = load_scene("cartpole").symmetries
    assert symmetries.positions == symmetries.velocities == {0}


def test_pendulum_ignores_nothing():
    symmetries = load_scene("double_pendulum").symmetries
    assert not symmetries.positions and not symmetries.velocities


@pytest.mark.parametrize(
    ("kind", "axis", "extra", "gravity", "position", "velocity"),
    [
        ("slide", "1 0 0", "", "0 0 -9.81", True, True),
        ("slide", "0 0 1", "", "0 0 -9.81", True, True),
        ("slide", "1 2 3", 'damping="0.1"', "0 0 -9.81", True, False),
        ("slide", "1 0 0", 'stiffness="0.1"', "0 0 -9.81", False, False),
        ("slide", "1 0 0", 'frictionloss="0.1"', "0 0 -9.81", True, False),
        ("hinge", "0 0 1", "", "0 0 -9.81", True, False),
        ("hinge", "0 1 0", "", "0 0 -9.81", False, False),
        ("hinge", "0 1 0", "", "0 0 0", True, False),
        ("slide", "1 0 0", 'range="-2 2" limited="true"', "0 0 -9.81", True, True),
    ],
)
def test_symmetries_follow_from_the_physics(
    kind, axis, extra, gravity, position, velocity
):
    xml = RAIL.format(kind=kind, axis=axis, extra=extra, gravity=gravity)
    symmetries = make_scene(xml).symmetries
    assert (0 in symmetries.positions, 0 in symmetries.velocities) == (
        position,
        velocity,
    )
    assert 1 not in symmetries.velocities


@every_scene
def test_every_scalar_coordinate_is_moved(scene):
    effects = scene.symmetries.effects
    joints = scalar_joints(scene) if scene.model.ntree == 1 else []  # props: none is
    for number, key in enumerate((QPOS, QVEL)):
        moved = {effect.address for effect in effects if effect.key == key}
        assert moved == {addresses[number] for addresses in joints}
    assert len(effects) == 2 * len(joints)


def test_looking_for_symmetries_leaves_the_model_alone(scene, generator):
    before = random_transitions(scene, 5, generator)
    flags = int(scene.model.opt.disableflags)
    scene.__dict__.pop("symmetries", None)
    assert scene.symmetries is not None
    assert scene.model.opt.disableflags == flags
    assert not flags & mujoco.mjtDisableBit.mjDSBL_LIMIT
    after = mujoco_step(scene, before, before["next", "joint_torque"])
    assert torch.equal(after["next", QVEL], before["next", QVEL])


GRIPPER = """<mujoco><worldbody><body><joint name="z" type="slide" axis="0 0 1"/>
<geom size="0.05" contype="0" conaffinity="0"/>
<body pos="0 0.04 0"><joint name="l" type="slide" axis="0 1 0"/><geom size="0.01"/></body>
<body pos="0 -0.04 0"><joint name="r" type="slide" axis="0 1 0"/><geom size="0.01"/></body>
</body></worldbody></mujoco>"""
BUNGEE = """<mujoco><worldbody><body><joint name="x" type="slide" axis="1 0 0"/>
<geom size="0.05"/></body></worldbody><tendon><fixed stiffness="20" springlength="0 4">
<joint joint="x" coef="1"/></fixed></tendon></mujoco>"""


def test_what_touches_or_pulls_seldom_is_kept():
    """Fingers that may meet, a cord that is slack: few states show what they do."""
    ignored = make_scene(GRIPPER).symmetries.positions
    assert ignored == {0}  # how high the hand is, but not where its fingers are
    assert make_scene(BUNGEE).symmetries.positions == set()


TURNING = """<mujoco><option gravity="0 0 0"/><worldbody>
  <body><joint name="a" axis="0 1 0" {joint}/><geom size="0.1" pos="0.2 0 0"/></body>
  <body pos="0 2 0"><joint name="b" axis="0 1 0"/><geom size="0.1" pos="0.2 0 0"/></body>
  </worldbody>{rest}</mujoco>"""
SPRING = """<tendon><fixed stiffness="5"><joint joint="a" coef="1"/>
  <joint joint="b" coef="-1"/></fixed></tendon>"""


@pytest.mark.parametrize(
    ("joint", "rest", "periodic"),
    [
        ("", "", [0, 1]),
        ('damping="1" frictionloss="0.1"', "", [0, 1]),
        ('stiffness="2"', "", [1]),
        ('range="-90 90"', "", [1]),
        ("", SPRING, []),
        ("", '<equality><joint joint1="a" joint2="b"/></equality>', []),
        ("", '<equality><joint joint1="b"/></equality>', [0]),
        ("", '<actuator><position joint="a" kp="3"/></actuator>', [1]),
        ("", '<actuator><velocity joint="a" kv="3"/></actuator>', [0, 1]),
    ],
)
def test_a_whole_turn_is_told_where_it_matters(joint, rest, periodic):
    """Measured in MuJoCo: the same step from a turn further on."""
    model = mujoco.MjModel.from_xml_string(TURNING.format(joint=joint, rest=rest))
    assert periodic_hinges(model, has_servos=True) == periodic
    for hinge in range(2):
        steps = []
        for turn in (0.0, 2.0 * torch.pi):
            data = mujoco.MjData(model)
            data.qpos[:] = 0.5, 0.4
            data.qpos[hinge] += turn
            data.qvel[:] = 0.3, -0.2
            mujoco.mj_step(model, data, 5)
            steps.append(data.qvel.copy())
        assert (abs(steps[0] - steps[1]).max() < 1e-9) == (hinge in periodic)
    without = periodic_hinges(model, has_servos=False)
    assert without == ([0, 1] if "position" in rest else periodic)
