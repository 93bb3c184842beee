"""Third-party robots: their actuators, grounds and steps are what their own model has."""

import copy
import os
from dataclasses import replace
from math import pi

import mujoco
import numpy as np
import pytest
import torch
from helpers import slow_but
from servo_helpers import servo_scene
from tensordict import TensorDict

from torchrl_nerd import make_env
from torchrl_nerd.checkpoint import load_checkpoint, make_card, save_checkpoint
from torchrl_nerd.cli import main
from torchrl_nerd.configs import NO_PREDICTIONS
from torchrl_nerd.data.generate import is_sound, simulate
from torchrl_nerd.dynamics import MujocoDynamics, NeRDDynamics
from torchrl_nerd.geometry.manifold import HINGE, SLIDE
from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.modules.nerd import NeRD, SceneFeatures
from torchrl_nerd.modules.networks import NETWORKS
from torchrl_nerd.robots import load_scene
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.commands import actuate
from torchrl_nerd.scenes.contact_points import ground_geoms
from torchrl_nerd.scenes.controllers import ActuatorController
from torchrl_nerd.scenes.ranges import CROSSING, LEAST_SPEED
from torchrl_nerd.scenes.sampling import sample_correlated_commands
from torchrl_nerd.tasks import SceneTask
from torchrl_nerd.transforms import StateDelta

ROWS = 20
STEPS = {  # control step (s), substeps: of the tasks and environments
    "dm_control/acrobot-swingup": (0.01, 1),
    "dm_control/cartpole-swingup": (0.01, 1),
    "dm_control/cheetah-run": (0.01, 1),
    "dm_control/hopper-hop": (0.02, 4),
    "dm_control/humanoid-run": (0.025, 5),
    "dm_control/point_mass-easy": (0.02, 1),
    "dm_control/reacher-easy": (0.02, 1),
    "dm_control/walker-walk": (0.025, 10),
    "gymnasium/Ant-v5": (0.05, 5),
    "gymnasium/HalfCheetah-v5": (0.05, 5),
    "gymnasium/Hopper-v5": (0.008, 4),
    "gymnasium/Humanoid-v5": (0.015, 5),
    "gymnasium/InvertedDoublePendulum-v5": (0.05, 5),
    "gymnasium/Swimmer-v5": (0.04, 4),
    "gymnasium/Walker2d-v5": (0.008, 4),
}
FEW = ("dm_control/reacher-easy", "gymnasium/HalfCheetah-v5", "gymnasium/Ant-v5")
"""On a fixed base, in a plane, on a floating base."""
PLANAR = [f"dm_control/{x}" for x in ("cheetah-run", "hopper-hop", "walker-walk")]
PLANAR += [f"gymnasium/{x}-v5" for x in ("HalfCheetah", "Hopper", "Walker2d")]

BODY = '<body><joint name="a"/><geom size="0.1"/></body>'
MOTOR = '<actuator><motor name="m" joint="a" {}/></actuator>'
REFUSED = {
    "an actuator with a state": (BODY, '<actuator><general name="m" joint="a" '
        'dyntype="filter" dynprm="0.1"/></actuator>'),
    "an actuator whose force a callback": (BODY, '<actuator><general name="m" joint="a" '
        'gaintype="user"/></actuator>'),
    "a delayed actuator": (BODY, MOTOR.format('delay="0.01" nsample="2"')),
    "a surface that moves": (BODY.replace("<geom", '<geom name="m" surfacevel="1 0 0"'),
        ""),
    "ground of another shape": ('<geom name="m" type="capsule" size="1 1"/>'
        + '<body><freejoint/><geom size="1"/></body>', ""),
    "a floating base whose": ('<body><freejoint/><geom size="1"/></body>',
        '<option wind="3 1 0" density="100"/>'),
    "a floating base whose .* an actuator": ('<body><freejoint name="a"/><geom size="1"/>'
        "</body>", MOTOR.format("")),
    "no joint": ('<body><geom size="1"/></body>', ""),
}  # fmt: skip


def write(folder, world, rest=""):
    path = folder / "robot.xml"
    path.write_text(f"<mujoco><worldbody>{world}</worldbody>{rest}</mujoco>")
    return path


@pytest.fixture(params=STEPS)
def robot(request) -> Scene:
    """Each imported robot."""
    return load_scene(request.param)


@pytest.fixture(params=["Euler", "RK4", "implicitfast"])
def servos(request, tmp_path) -> Scene:
    """A robot with all kinds of servos."""
    return servo_scene(tmp_path, request.param)


def states_and_actions(scene, generator, clearance=None):
    """Random states, some of them in the ground, and random actions, ``[ROWS]``."""
    sampling = replace(scene.sampling, clearance=clearance, penetration=None)
    anywhere = replace(scene, sampling=sampling)
    state, _ = anywhere.sample_initial(ROWS, generator)
    u = torch.rand(ROWS, scene.controller.num_actions, generator=generator).double()
    return TensorDict(state, batch_size=[ROWS]), 2.4 * u - 1.2


def set_up(scene, state, action, row, model=None):
    """MuJoCo's data of one row, with the controls that its action stands for."""
    model = scene.model if model is None else model
    data = mujoco.MjData(model)
    data.qpos, data.qvel = state[QPOS][row], state[QVEL][row]
    limits = model.actuator_ctrlrange.copy()
    limits[model.actuator_ctrllimited == 0] = (-1.0, 1.0)
    share = 0.5 * (action[row].clamp(-1.0, 1.0).numpy() + 1.0)
    data.ctrl = limits[:, 0] + share * (limits[:, 1] - limits[:, 0])
    return data


def check_torques(scene, generator):
    state, action = states_and_actions(scene, generator)
    torque = scene.controller(action, state[QPOS], state[QVEL])
    assert len(set(scene.actuated)) == len(scene.actuated) == torque.shape[-1]
    for row in range(ROWS):
        data = set_up(scene, state, action, row)
        mujoco.mj_forward(scene.model, data)
        force = np.zeros(scene.model.nv)
        force[scene.actuated] = torque[row]
        size = 1.0 + abs(force).max()
        np.testing.assert_allclose(force, data.qfrc_actuator, 0.0, 1e-12 * size)


def check_steps(scene, generator):
    """One control step is the original model's, bit for bit, its controls held."""
    state, action = states_and_actions(scene, generator)
    dynamics = MujocoDynamics(scene, num_threads=1)
    torque, ctrl = actuate(scene.controller, action, state[QPOS], state[QVEL])
    after = dynamics.step(state, torque, None, ctrl)
    for row in range(ROWS):
        data = set_up(scene, state, action, row)
        np.testing.assert_allclose(data.ctrl, ctrl[row], 1e-12)
        data.ctrl = ctrl[row]
        mujoco.mj_step(scene.model, data, scene.substeps)
        for key, want in ((QPOS, data.qpos), (QVEL, data.qvel)):
            np.testing.assert_array_equal(after[key][row], want)
    return state, torque, after


def test_torques_are_the_actuators(robot, generator):
    check_torques(robot, generator)
    assert robot.controller.num_actions == robot.model.nu


def test_servo_torques_are_the_actuators(servos, generator):
    check_torques(servos, generator)
    assert not servos.controller.is_motor and len(servos.actuated) == 6


def test_mujoco_steps_are_the_original_models(robot, generator):
    assert robot.controller.is_motor and robot.servos is None
    state, torque, after = check_steps(robot, generator)
    held = MujocoDynamics(robot, num_threads=1).step(state, torque)
    for key in (QPOS, QVEL):  # a motor's torque says the same, but for rounding
        size = 1.0 + after[key].abs().amax(1, keepdim=True)
        assert ((held[key] - after[key]).abs() <= 1e-10 * size).all()


def test_mujoco_steps_of_servos_are_the_originals(servos, generator):
    assert servos.servos is servos.controller
    check_steps(servos, generator)


def test_a_dm_control_episode_is_dm_controls_own(generator):
    from dm_control import suite

    scene, env = load_scene("dm_control/walker-walk"), suite.load("walker", "walk")
    state, action = states_and_actions(scene, generator, clearance=0.1)
    torque = scene.controller(action, state[QPOS], state[QVEL])
    after = MujocoDynamics(scene, num_threads=1).step(state, torque)
    for row in range(ROWS):
        env.reset()
        with env.physics.reset_context():
            env.physics.data.qpos[:] = state[QPOS][row]
            env.physics.data.qvel[:] = state[QVEL][row]
        env.step(action[row].clamp(-1.0, 1.0).numpy())
        for key in (QPOS, QVEL):
            want = getattr(env.physics.data, key)
            np.testing.assert_allclose(after[key][row], want, 0.0, 1e-6)


def test_control_steps_are_the_tasks(robot):
    control_step, substeps = STEPS[robot.name]
    assert abs(robot.control_step - control_step) < 1e-12
    assert robot.substeps == substeps


@pytest.mark.parametrize("robot", slow_but(FEW, STEPS), indirect=True)
def test_a_network_can_step_it(robot, generator):
    state, action = states_and_actions(robot, generator, robot.sampling.clearance)
    torque = robot.controller(action, state[QPOS], state[QVEL])
    dynamics = NeRDDynamics(NeRD(robot, NO_PREDICTIONS, NETWORKS["transformer-2x64"]))
    features = dynamics.model.scene_features
    tokens = features(state[QPOS], state[QVEL], torque, None)
    assert tokens.shape == (ROWS, features.size)
    for after in (
        dynamics.step(state, torque),
        MujocoDynamics(robot, num_threads=1).step(state, torque),
    ):
        assert all(after[key].shape == state[key].shape for key in (QPOS, QVEL))
        assert all(after[key].isfinite().all() for key in (QPOS, QVEL))
        change = StateDelta(robot)
        start = state[QPOS], state[QVEL]
        delta = change.delta(*start, after[QPOS], after[QVEL])
        again = change.delta(*start, *change.integrate(*start, delta))
        torch.testing.assert_close(again, delta, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", [*PLANAR, "gymnasium/Swimmer-v5"])
def test_a_planar_robot_does_not_see_where_it_is(name, generator):
    scene = load_scene(name)
    model = scene.model
    assert not scene.base.is_floating
    root = next(
        j
        for j in range(model.njnt)
        if model.jnt_type[j] == SLIDE and abs(model.jnt_axis[j][0]) == 1.0
    )
    address = int(model.jnt_qposadr[root])
    assert address in scene.symmetries.positions
    state, action = states_and_actions(scene, generator)
    torque = scene.controller(action, state[QPOS], state[QVEL])
    tokens, elsewhere = SceneFeatures(scene), state[QPOS].clone()
    elsewhere[:, address] += 1e4
    here = tokens(state[QPOS], state[QVEL], torque, None)
    there = tokens(elsewhere, state[QVEL], torque, None)
    torch.testing.assert_close(here, there, rtol=0.0, atol=1e-8)


def test_the_nearest_point_gives_the_robots_clearance(robot, generator):
    points, model = robot.contacts, robot.model
    if robot.terrain is None:
        assert len(points) == 0
        return
    state, _ = states_and_actions(robot, generator)
    gaps, data = robot.clearances(state[QPOS]), mujoco.MjData(model)
    (ground,) = ground_geoms(model)
    bodies = set(points.bodies)
    geoms = [
        geom
        for geom in range(model.ngeom)
        if model.geom_bodyid[geom] in bodies
        and model.geom_contype[geom] | model.geom_conaffinity[geom]
    ]
    for row in range(ROWS):
        data.qpos = state[QPOS][row]
        mujoco.mj_kinematics(model, data)
        want = min(
            mujoco.mj_geomDistance(model, data, ground, geom, 1e3, None)
            for geom in geoms
        )
        assert abs(float(gaps[row].min()) - want) < 1e-9


def test_starts_are_within_the_limits_and_clear_of_the_ground(robot, generator):
    state, _ = states_and_actions(robot, generator, robot.sampling.clearance)
    model, qpos = robot.model, state[QPOS]
    for joint in range(model.njnt):
        q, kind = model.jnt_qposadr[joint], model.jnt_type[joint]
        if kind not in (HINGE, SLIDE):
            continue
        low, high = model.jnt_range[joint]
        if not model.jnt_limited[joint]:
            width = pi if kind == HINGE else 1.0
            low, high = model.qpos0[q] - width, model.qpos0[q] + width
        assert (qpos[:, q] >= low).all() and (qpos[:, q] <= high).all()
    if robot.terrain is not None:
        assert robot.clearances(qpos).amin() >= 0.0


SOUND = ("dm_control/hopper-hop", "gymnasium/Ant-v5", "dm_control/swimmer-swimmer15")


@pytest.mark.parametrize("name", (*SOUND, "dm_control/fish-upright"))
def test_random_trajectories_stay_sound(name, generator):
    scene = load_scene(name)
    data = simulate(scene, 16, 20, generator)
    assert is_sound(data).all()
    if scene.servos is None:  # whose torque follows from the state
        largest = torch.tensor(scene.sampling.torque, dtype=torch.float64)
        assert (data["next", "joint_torque"].abs() <= largest).all()


def test_servos_are_driven_by_random_controls(servos, generator):
    """Uniform about the middle of their ranges, as far from it as the state's scale."""
    low, high = torch.from_numpy(servos.model.actuator_ctrlrange.copy()).T
    is_free = servos.model.actuator_ctrllimited == 0
    low[is_free], high[is_free] = -1.0, 1.0
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    scale = torch.rand(2000, 1, generator=generator).double()
    for times in (None, (0.004, 0.1)):
        sampling = replace(servos.sampling, correlation_time=times)
        ctrl = sample_correlated_commands(sampling, scale, 5, 0.004, generator)
        share = (ctrl - middle) / (scale[:, None] * half)
        assert share.abs().max() <= 1.0 + 1e-9 and ctrl.shape == (2000, 5, 8)
        assert abs(share.square().mean() - 1.0 / 3.0) < 0.01
    data = simulate(servos, 4, 20, generator)
    assert is_sound(data).all() and data["next", "ctrl"].shape == (4, 20, 8)
    expected = servos.servos.torque(data["next", "ctrl"], data[QPOS], data[QVEL])
    assert torch.equal(data["next", "joint_torque"], expected)


def test_no_joint_starts_so_fast_that_it_crosses_its_range_in_a_moment(robot):
    model, fastest = robot.model, robot.sampling.qvel_high
    for joint in np.flatnonzero(model.jnt_limited):
        v = int(model.jnt_dofadr[joint]) - model.nv
        width = float(np.ptp(model.jnt_range[joint]))
        assert fastest[v] <= max(1.005 * width / CROSSING, LEAST_SPEED)


def test_ranges_can_be_given():
    scene = Scene.from_gymnasium("Ant-v5", qvel_high=(2.0,) * 8, clearance=0.3)
    assert scene.sampling.qvel_high == (2.0,) * 8 and scene.sampling.clearance == 0.3
    assert scene.sampling.qpos_low == load_scene("gymnasium/Ant-v5").sampling.qpos_low
    state, _ = scene.sample_initial(50, torch.Generator().manual_seed(0))
    assert scene.clearances(state[QPOS]).min() >= 0.3
    buried = Scene.from_gymnasium("Hopper-v5", clearance=1e3)
    with pytest.raises(ValueError, match="states clear of the ground"):
        buried.sample_initial(1, torch.Generator().manual_seed(0))


def test_names_stand_for_imports(tmp_path):
    assert load_scene("gymnasium/Ant-v5") is load_scene("gymnasium/Ant-v5")
    assert Scene.from_gymnasium("Ant-v5").hash == load_scene("gymnasium/Ant-v5").hash
    scene = load_scene("dm_control/cheetah-run")
    assert Scene.from_dm_control("cheetah", "run").hash == scene.hash
    path = write(tmp_path, BODY, MOTOR.format(""))
    scene = load_scene(str(path))
    assert scene.name == str(path) and isinstance(scene.controller, ActuatorController)
    assert scene.substeps == 10 and scene.actuated == [0]


def test_data_can_be_drawn_from_a_name(tmp_path):
    out, name = tmp_path / "data", "gymnasium/InvertedPendulum-v5"
    sizes = ("--trajectories", "4", "--steps", "3")
    assert main(["data", name, "--out", str(out), *sizes, "--quiet"]) == 0
    assert main(["data", name, "--out", str(out), *sizes, "--quiet"]) == 0


@pytest.mark.parametrize("is_file", [True, False])
def test_a_checkpoint_finds_its_robot_again(is_file, tmp_path):
    scene = servo_scene(tmp_path) if is_file else load_scene("gymnasium/Ant-v5")
    model = NeRD(scene, NO_PREDICTIONS, NETWORKS["transformer-2x64"])
    save_checkpoint(model, tmp_path / "checkpoint", make_card(model))
    again = load_checkpoint(tmp_path / "checkpoint", scene if is_file else None)
    assert again.scene.hash == scene.hash
    with pytest.raises(ValueError, match="unknown scene 'unicycle'"):
        card = make_card(model) | {"scene": "unicycle"}
        load_checkpoint(save_checkpoint(model, tmp_path / "other", card))


@pytest.mark.parametrize(
    "change",
    [
        lambda m: m.body_gravcomp.__iadd__(0.5),
        lambda m: m.qpos_spring.__iadd__(0.5),
        lambda m: m.dof_solref.__imul__(2.0),
        lambda m: m.dof_dampingpoly[-1].__iadd__(0.1),
        lambda m: setattr(m.opt, "noslip_iterations", 3),
        lambda m: m.actuator_gainprm.__imul__(2.0),
        lambda m: m.actuator_biasprm.__iadd__(0.5),
        lambda m: m.actuator_forcerange.__iadd__(0.5),
        lambda m: m.actuator_ctrlrange.__imul__(2.0),
        lambda m: m.jnt_bodyid[-1:].__iadd__(1),
    ],
)
def test_rare_physics_changes_the_hash(change, robot):
    again = replace(robot, model=copy.copy(robot.model))
    assert again.hash == robot.hash
    change(again.model)
    assert replace(again).hash != robot.hash


@pytest.mark.parametrize("named", REFUSED)
def test_what_cannot_be_learned_is_refused_by_name(named, tmp_path):
    with pytest.raises(ValueError, match=named) as error:
        Scene.from_mjcf(write(tmp_path, *REFUSED[named]))
    said = str(error.value)
    assert "\n" not in said and ("'m'" in said or "robot.xml" in said)


def test_all_reasons_are_named_at_once(tmp_path):
    world = (
        '<geom name="log" type="cylinder" size="1 1"/><body name="torso"><freejoint/>'
    )
    world += '<geom size="1"/><body name="arm"><joint name="a"/><geom size="1"/></body>'
    path = write(tmp_path, world + "</body>", "<actuator>" + 5 * (
        '<general joint="a" dyntype="filter" dynprm="0.1"/>') + "</actuator>"
        '<option wind="3 1 0" density="100"><flag sleep="enable"/></option>')  # fmt: skip
    with pytest.raises(ValueError) as error:
        Scene.from_mjcf(path)
    said = str(error.value)
    for part in (str(path), "'0' of 'arm'", "and 2 more", "'log' of 'world', a cyl"):
        assert part in said
    assert "may sleep" in said and "where it is or faces" in said


@pytest.mark.parametrize(
    ("name", "why"),
    [
        (
            "dm_control/quadruped-walk",
            "actuator with a state .*'yaw_front_left' of 'hip",
        ),
        ("gymnasium/Ant-v4", "expected an environment .* version 5"),
        ("gymnasium/CartPole-v1", "expected an environment"),
        ("gymnasium/Unicycle-v5", "unknown environment 'Unicycle-v5'"),
        ("dm_control/unicycle-ride", "unknown domain .* expected one of acrobot"),
        ("dm_control/cheetah-fly", "unknown task .* expected one of run$"),
        ("dm_control/cheetah", "unknown task in .*cheetah', expected one of run$"),
        ("gymnasium/", "unknown environment '' of Gymnasium"),
        ("nowhere/robot.xml", "expected an MJCF file, found none at nowhere"),
    ],
)
def test_robots_that_cannot_be_had_are_refused_in_one_sentence(name, why):
    with pytest.raises(ValueError, match=why) as error:
        load_scene(name)
    assert "\n" not in str(error.value)


def test_files_that_do_not_compile_are_refused_in_one_sentence(tmp_path):
    twice = BODY + BODY
    for world, why in ((twice, "repeated name 'a'"), ("<body", "XML"), ("<x/>", "x")):
        with pytest.raises(ValueError, match="MuJoCo cannot compile") as error:
            Scene.from_mjcf(write(tmp_path, world))
        assert why in str(error.value) and "\n" not in str(error.value)
    with pytest.raises(ValueError, match="whole timesteps of 0.002 s, got 0.003 s"):
        Scene.from_mjcf(write(tmp_path, BODY), control_step=0.003)


def test_a_ground_per_env_needs_somebody_to_draw_it(tmp_path):
    world = '<body mocap="true"><geom type="plane" size="1 1 1"/></body>'
    world += (
        '<body pos="0 0 1"><joint name="a"/><geom size="0.1" pos="0.3 0 0"/></body>'
    )
    path = write(tmp_path, world)
    with pytest.raises(ValueError, match="expected ground="):
        Scene.from_mjcf(path)

    def level(qpos, generator):
        return torch.tensor([0.0, 0.0, 1.0, 0.0]).double().expand(len(qpos), 4)

    assert Scene.from_mjcf(path, ground=level).terrain.is_per_env


@pytest.mark.parametrize("control_step", [float("nan"), float("inf"), 0, -0.02, "a"])
def test_a_control_step_is_a_length_of_time(control_step, tmp_path):
    with pytest.raises(ValueError) as error:
        Scene.from_mjcf(write(tmp_path, BODY), control_step=control_step)
    assert f"whole timesteps of 0.002 s, got {control_step!r}" in str(error.value)


@pytest.mark.parametrize(
    ("ranges", "why"),
    [
        ({"grond": None}, "expected ranges among qpos_low, .*, got 'grond'"),
        ({"zero_torque_fraction": 1.1}, "zero_torque_fraction from 0 to 1, got 1.1"),
        ({"low_torque_fraction": -0.1}, "low_torque_fraction from 0 to 1, got -0.1"),
        ({"low_torque_fraction": float("nan")}, "from 0 to 1, got nan"),
        ({"qpos_low": (0.0, 0.0, 0.0)}, "qpos_low of length 1, got 3"),
        ({"qvel_high": ()}, "qvel_high of length 1, got 0"),
        ({"torque": (1.0, 1.0)}, "torque of length 0, got 2"),
        ({"qpos_low": (9.0,)}, "qpos from low to high, got 9.0 and"),
        ({"qvel_high": (float("nan"),)}, "qvel from low to high, got .* and nan"),
        ({"max_contact_points": 0}, "max_contact_points.* at least 1, got 0"),
    ],
)
def test_ranges_that_cannot_be_are_refused(ranges, why, tmp_path):
    with pytest.raises(ValueError, match=why) as error:
        Scene.from_mjcf(write(tmp_path, BODY), **ranges)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"torque": (-1.0,) * 8}, "torque from low to high, got 0.0 and -1.0"),
        ({"ctrl": ((1.0,), (-1.0,))}, "ctrl from low to high, got 1.0 and -1.0"),
        ({"tilt": float("nan")}, "base.tilt from low to high, got 0.0 and nan"),
        ({"low": (0.0, 0.0)}, "base of three numbers, got"),
        ({"low": (0.0, 0.0, 9.0)}, "base from low to high, got 9.0 and"),
    ],
)
def test_ranges_of_a_base_and_of_what_drives_are_in_order(changes, why):
    sampling = load_scene("ant").sampling
    if changes.keys() & {"tilt", "low"}:
        changes = {"base": replace(sampling.base, **changes)}
    with pytest.raises(ValueError, match=why):
        replace(load_scene("ant"), sampling=replace(sampling, **changes))


@pytest.mark.parametrize("name", [None, 5, ["ant"], ("ant",)])
def test_what_is_no_name_is_no_scene(name):
    with pytest.raises(ValueError, match="unknown scene .*, expected one of"):
        load_scene(name)


FLOATING = """<mujoco><worldbody>{ground}<body pos="0 0 1"><freejoint/><geom size="0.1"/>
  </body></worldbody></mujoco>"""


def test_a_plane_for_a_file_without_ground(tmp_path):
    """The robot comes to rest on it, as on a plane of the file; two are one too many."""
    bare, floored = (tmp_path / f"{name}.xml" for name in ("bare", "floored"))
    bare.write_text(FLOATING.format(ground=""))
    floored.write_text(FLOATING.format(ground='<geom type="plane" size="0 0 1"/>'))
    assert Scene.from_mjcf(bare).terrain is None
    scenes = [Scene.from_mjcf(bare, terrain="plane"), Scene.from_mjcf(floored)]
    heights = []
    for scene in scenes:
        env = make_env(SceneTask(scene), "mujoco", seed=0)
        heights.append(
            env.rollout(200, break_when_any_done=False)["next", "qpos"][..., 2]
        )
    assert torch.equal(*heights) and abs(float(heights[0][0, -1]) - 0.1) < 0.01
    with pytest.raises(ValueError, match="no ground beside a plane"):
        Scene.from_mjcf(floored, terrain="plane")
    with pytest.raises(ValueError, match="terrain 'plane' or None, got 'hills'"):
        Scene.from_mjcf(bare, terrain="hills")  # pyright: ignore


@pytest.mark.parametrize(
    "default",
    [
        *("", 'contype="0" conaffinity="0"', 'pos="0 0 0.5"', 'friction="0"'),
        'euler="90 0 0"',
    ],
)
def test_an_added_plane_is_level_ground_whatever_geoms_are_by_default(
    default, tmp_path
):
    (tmp_path / "ball.xml").write_text(f"""<mujoco><default><geom {default}/>
      <default class="hull"><geom contype="1" conaffinity="1" pos="0 0 0"/></default>
      </default><worldbody><body pos="0 0 1"><freejoint/>
      <geom class="hull" size="0.1"/></body></worldbody></mujoco>""")
    scene = Scene.from_mjcf(tmp_path / "ball.xml", terrain="plane")
    data = mujoco.MjData(scene.model)
    mujoco.mj_step(scene.model, data, 1000)
    assert len(scene.contacts) == 1 and abs(data.qpos[2] - 0.1) < 0.01
    [plane] = np.flatnonzero(scene.model.geom_bodyid == 0)
    assert scene.model.geom_friction[plane].tolist() == [1.0, 0.005, 0.0001]


BOX = '<body pos="{} 0 {}"><freejoint/><geom type="box" size=".05 .05 .05"/></body>'
GROUNDS = {
    "a thick floor": ('<geom type="box" size="9 9 .5" pos="0 0 -.5"/>', 0.0, 0.3),
    "a platform elsewhere": ('<geom type="box" size="2 2 1" pos="20 0 0"/>', 20.0, 1.5),
    "a table over a floor": (
        '<geom type="plane" size="9 9 1"/>'
        '<geom type="box" size="3 3 .1" pos="0 0 .9"/>',
        *(0.0, 1.2),
    ),
}


@pytest.mark.parametrize("ground", GROUNDS)
def test_a_free_robot_falls_on_the_ground_below_its_place(ground, generator, tmp_path):
    text, x, z = GROUNDS[ground]
    body = BOX.format(x, z)
    (tmp_path / "box.xml").write_text(
        f"<mujoco><worldbody>{text}{body}</worldbody></mujoco>"
    )
    scene = Scene.from_mjcf(tmp_path / "box.xml")
    data = simulate(scene, 16, 100, generator)
    end = data["next", "qpos"][is_sound(data)][:, -1]
    top = {"a thick floor": 0.0}.get(ground, 1.0)
    assert ((end[:, 2] > top) & (end[:, 2] < top + 0.1)).double().mean() > 0.9
    assert ((end[:, 0] - x).abs() < 2.0).all()


def test_a_path_means_the_file_that_is_there(tmp_path, monkeypatch):
    """In another folder, or after a change, it is another robot; else the same object."""
    body = "<body><joint type='hinge'/><geom size='{}'/></body>"
    text = f"<mujoco><worldbody>{body}</worldbody></mujoco>"
    for folder, size in (("a", 0.1), ("b", 0.2)):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "robot.xml").write_text(text.format(size))
    sizes = []
    for folder in ("a", "b"):
        monkeypatch.chdir(tmp_path / folder)
        assert load_scene("robot.xml") is load_scene("robot.xml")
        sizes.append(float(load_scene("robot.xml").model.geom_size[0, 0]))
    (tmp_path / "b" / "robot.xml").write_text(text.format(0.3))
    os.utime("robot.xml", ns=(0, 0))  # clocks of some file systems are coarse
    sizes.append(float(load_scene("robot.xml").model.geom_size[0, 0]))
    assert sizes == [0.1, 0.2, 0.3]


def test_a_plane_that_nothing_can_touch_is_not_added(tmp_path):
    path = write(tmp_path, BODY.replace("<geom", '<geom contype="0" conaffinity="0"'))
    with pytest.raises(
        ValueError, match="shapes that can touch a plane in .*robot.xml"
    ):
        Scene.from_mjcf(path, terrain="plane")


def test_a_plane_has_no_end(tmp_path):
    """A robot beside its drawn part starts over it, too."""
    floor = '<geom type="plane" size="1 1 1" pos="0 0 3"/>'
    ball = '<body pos="4 0 3.5"><freejoint/><geom size="0.1"/></body>'
    scene = Scene.from_mjcf(write(tmp_path, floor + ball))
    qpos = scene.sample_initial(20, torch.Generator().manual_seed(0))[0]["qpos"]
    assert (qpos[:, 2] >= 3.1 - 1e-9).all()


@pytest.mark.parametrize("default", ['fromto="0 0 0 0 0 1"', 'type="mesh" mesh="m"'])
def test_an_added_plane_is_no_capsule_or_mesh(default, tmp_path):
    """Which MuJoCo would refuse to make level ground of."""
    (tmp_path / "body.xml").write_text(
        f"""<mujoco><asset>
      <mesh name="m" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/></asset>
      <default><geom size="0.1" {default}/></default><worldbody>
      <body pos="0 0 1"><freejoint/><geom/></body></worldbody></mujoco>""".replace(
            "<geom/>", "<geom/>" if "mesh" in default else '<geom type="capsule"/>'
        )
    )
    scene = Scene.from_mjcf(tmp_path / "body.xml", terrain="plane")
    assert scene.terrain.fixed_plane.tolist() == [0.0, 0.0, 1.0, 0.0]


def test_a_gap_to_no_ground_is_none(tmp_path):
    path = write(tmp_path, '<body><joint/><geom size="0.1"/></body>')
    scene = Scene.from_mjcf(path, clearance=0.01)
    state, _ = scene.sample_initial(4, torch.Generator().manual_seed(0))
    assert state[QPOS].shape == (4, 1)


def test_a_range_of_what_nothing_reads_is_refused(tmp_path):
    arm = '<body><joint name="j"/><geom size="0.1"/></body>'
    for kind, other in (("position", "torque"), ("motor", "ctrl")):
        rest = f'<actuator><{kind} joint="j"/></actuator>'
        path = write(tmp_path, arm, rest)
        with pytest.raises(ValueError, match=f"got a range of '{other}'"):
            Scene.from_mjcf(path, **{other: (1.0,)})
