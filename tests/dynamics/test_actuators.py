"""MuJoCo's own actuators: every dynamics that is exact steps as ``mj_step`` does."""

import os
from dataclasses import replace
from glob import glob

import mujoco
import numpy as np
import pytest
import torch
from dynamics_helpers import random_model
from helpers import slow_but
from servo_helpers import ENGINE_ALONE, SERVOS, arm_scene, servo_scene
from tensordict import TensorDict

from torchrl_nerd import make_env
from torchrl_nerd.dynamics import (
    DMControlDynamics,
    GuardedDynamics,
    MujocoDynamics,
    NeRDDynamics,
)
from torchrl_nerd.dynamics.dm_control import make_physics
from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.robots import load_scene
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.commands import actuate, num_ctrl
from torchrl_nerd.tasks import SceneTask

ROWS, STEPS = 3, 50
COVER = ("dm_control/humanoid-run", "gymnasium/Walker2d-v5")
GYMNASIUM = """Ant HalfCheetah Hopper Humanoid HumanoidStandup InvertedPendulum
    InvertedDoublePendulum Pusher Reacher Swimmer Walker2d"""
SUITE = """acrobot-swingup ball_in_cup-catch cartpole-swingup cheetah-run dog-run
    finger-spin fish-swim hopper-hop humanoid-run humanoid_CMU-run lqr-lqr_2_1
    manipulator-bring_ball pendulum-swingup point_mass-easy quadruped-walk reacher-easy
    stacker-stack_2 swimmer-swimmer6 walker-walk"""
FILES = os.environ.get("NERD_MJCF", "no folder of MJCF files")
ROBOTS = [
    *(f"gymnasium/{name}-v5" for name in GYMNASIUM.split()),
    *(f"dm_control/{name}" for name in SUITE.split()),
    *sorted(glob(f"{FILES}/**/*.xml", recursive=True)),
]
"""Third-party robots; the environment variable ``NERD_MJCF`` names a folder of more."""


def start_of(scene: Scene, generator: torch.Generator) -> TensorDict:
    """States of the scene's ranges, clear of the ground or not."""
    anywhere = replace(scene, sampling=replace(scene.sampling, clearance=None))
    return TensorDict(anywhere.sample_initial(ROWS, generator)[0], [ROWS])


def random_actions(scene: Scene, generator: torch.Generator) -> torch.Tensor:
    size = (STEPS, ROWS, scene.controller.num_actions)
    return 2.0 * torch.rand(size, generator=generator).double() - 1.0


def check_steps(scene: Scene, generator: torch.Generator) -> None:
    """50 control steps under random controls are ``mj_step``'s, bit for bit."""
    state, dynamics = start_of(scene, generator), MujocoDynamics(scene, num_threads=1)
    dynamics.reset(state)
    simulations = []
    for row in range(ROWS):
        data = mujoco.MjData(scene.model)
        data.qpos, data.qvel = state[QPOS][row], state[QVEL][row]
        simulations.append(data)
    is_sound = np.ones(ROWS, bool)
    for action in random_actions(scene, generator):
        torque, ctrl = actuate(scene.controller, action, state[QPOS], state[QVEL])
        state = dynamics.step(state, torque, None, ctrl)
        for row, data in enumerate(simulations):
            data.ctrl = ctrl[row]
            mujoco.mj_step(scene.model, data, scene.substeps)
            is_sound[row] &= not data.warning.number.any()
            for key in (QPOS, QVEL) if is_sound[row] else ():
                np.testing.assert_array_equal(state[key][row], getattr(data, key))
    assert is_sound.any()


@pytest.mark.parametrize("name", slow_but(COVER, ROBOTS))
def test_imported_robots_are_stepped_by_mujoco(name, generator):
    try:
        scene = load_scene(name)
    except ValueError as refused:
        pytest.skip(str(refused))
    check_steps(scene, generator)


@pytest.mark.parametrize("integrator", ["Euler", "RK4", "implicit", "implicitfast"])
def test_every_actuator_without_a_state_is_mujocos(integrator, tmp_path, generator):
    scene = servo_scene(tmp_path, integrator, more=ENGINE_ALONE)
    assert num_ctrl(scene) == scene.model.nu == 16 and len(scene.actuated) == 6
    check_steps(scene, generator)


def test_gravity_compensation_of_actuators_is_mujocos(tmp_path, generator):
    path = tmp_path / "compensated.xml"
    text = SERVOS.format(integrator="Euler", more="")
    path.write_text(text.replace('name="b"', 'name="b" actuatorgravcomp="true"'))
    scene = Scene.from_mjcf(path, control_step=0.004)
    assert scene.model.jnt_actgravcomp.any() and scene.servos is not None
    check_steps(scene, generator)


def test_an_arm_at_rest_stays_at_rest(tmp_path):
    """Held torques made stiff servos buzz at several rad/s."""
    scene = arm_scene(tmp_path)
    data = mujoco.MjData(scene.model)
    mujoco.mj_resetDataKeyframe(scene.model, data, 0)
    qpos, ctrl = (torch.from_numpy(x.copy())[None] for x in (data.qpos, data.ctrl))
    state = TensorDict({QPOS: qpos, QVEL: 0.0 * qpos}, [1])
    states = MujocoDynamics(scene).rollout(
        state, None, None, ctrl[:, None].expand(1, 300, 2)
    )
    mujoco.mj_step(scene.model, data, 300 * scene.substeps)
    assert np.array_equal(states[QVEL][0, -1], data.qvel)
    assert states[QVEL][0, -1].abs().max() < 1e-6


def test_dm_control_steps_servos_as_its_own_physics(tmp_path, generator):
    scene = servo_scene(tmp_path)
    state, dynamics = start_of(scene, generator), DMControlDynamics(scene)
    physics = [make_physics(scene, has_actuators=True) for _ in range(ROWS)]
    for row, one in enumerate(physics):
        with one.reset_context():
            one.data.qpos[:], one.data.qvel[:] = state[QPOS][row], state[QVEL][row]
        mujoco.mj_fwdVelocity(one.model.ptr, one.data.ptr)  # it left out its actuators
    for action in random_actions(scene, generator)[:10]:
        torque, ctrl = actuate(scene.controller, action, state[QPOS], state[QVEL])
        state = dynamics.step(state, torque, None, ctrl)
        for row, one in enumerate(physics):
            one.set_control(ctrl[row].numpy())
            one.step(scene.substeps)
            for key in (QPOS, QVEL):
                np.testing.assert_array_equal(state[key][row], getattr(one.data, key))


def test_an_env_of_servos_is_mujoco_after_partial_resets_too(tmp_path, generator):
    scene = servo_scene(tmp_path)
    env = make_env(SceneTask(scene), "mujoco", num_envs=ROWS, seed=0)
    td, again = env.reset(), None
    for step, action in enumerate(random_actions(scene, generator)[:12]):
        td = env.step(td.set("action", action.float()))["next"]
        ctrl = scene.controller.ctrl(action.float().double())
        assert torch.equal(td["ctrl"], ctrl)
        if step == 4:  # one env starts again, somewhere else
            there = start_of(scene, generator)
            td["_reset"] = torch.arange(ROWS)[:, None] == 1
            td[QPOS], td[QVEL] = there[QPOS], there[QVEL]
            td = env.reset(td, set_state=True)
            again = mujoco.MjData(scene.model)
            again.qpos, again.qvel = there[QPOS][1], there[QVEL][1]
        elif again is not None:
            again.ctrl = ctrl[1]
            mujoco.mj_step(scene.model, again, scene.substeps)
    for key in (QPOS, QVEL):
        np.testing.assert_array_equal(td[key][1], getattr(again, key))


def test_the_guards_fallback_steps_servos_with_mujoco(tmp_path, generator):
    scene = servo_scene(tmp_path)
    learned = NeRDDynamics(random_model(scene, generator))
    state = start_of(scene, generator)
    state[QVEL] = 1e3 * state[QVEL]
    action = random_actions(scene, generator)[0]
    torque, ctrl = actuate(scene.controller, action, state[QPOS], state[QVEL])
    after = GuardedDynamics(learned, "fallback").step(state, torque, None, ctrl)
    exact = MujocoDynamics(scene).step(state, torque, None, ctrl)
    assert (after["trust"] < 1.0).all()
    for key in (QPOS, QVEL):
        assert torch.equal(after[key].nan_to_num(), exact[key].nan_to_num())


def test_a_step_with_controls_and_one_with_a_torque_take_turns(tmp_path, generator):
    """Each as from dynamics of its own, with the warm start of the step before."""
    scene = servo_scene(tmp_path)
    state, action = start_of(scene, generator), random_actions(scene, generator)[0]
    torque, ctrl = actuate(scene.controller, action, state[QPOS], state[QVEL])
    both = MujocoDynamics(scene)
    for told in (ctrl, None, ctrl):
        alone = MujocoDynamics(scene)
        for dynamics in (both, alone):
            dynamics.reset(state)
        after, want = (d.step(state, torque, None, told) for d in (both, alone))
        for key in (QPOS, QVEL):
            assert torch.equal(after[key], want[key])


def test_bad_controls_are_refused_in_one_sentence(tmp_path, generator):
    scene = servo_scene(tmp_path)
    state = start_of(scene, generator)
    torque = torch.zeros(ROWS, len(scene.actuated)).double()
    learned = NeRDDynamics(random_model(scene, generator))
    wide = torch.zeros(ROWS, 9).double()
    for dynamics in (MujocoDynamics(scene), learned):
        with pytest.raises(ValueError, match=r"ctrl of shape \(3, 8\), got \(3, 9\)"):
            dynamics.step(state, torque, None, wide)
    with pytest.raises(ValueError, match="servos, which a model knows by their ctrl"):
        learned.step(state, torque)
    with pytest.raises(ValueError, match="a joint torque or ctrl, got neither"):
        MujocoDynamics(scene).rollout(state, None)
    with pytest.raises(ValueError, match="got scene .* with .*servos of MuJoCo"):
        make_env(SceneTask(scene), "analytic")
