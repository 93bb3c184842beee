"""Tasks of the dm_control suite: its own environments are the only reference."""

import copy
import pickle

import numpy as np
import pytest
import torch
from dm_control import suite
from dynamics_helpers import (
    act,
    act_all,
    assert_same_motion,
    random_actions,
    random_drive,
    random_model,
    row_uniforms,
    start_at,
)
from torchrl.envs.utils import check_env_specs

from torchrl_nerd import NeRDEnv, Scene, load_scene, make_env
from torchrl_nerd.checkpoint import load_checkpoint, make_card, save_checkpoint
from torchrl_nerd.robots import make_task

SUITE = [
    *("acrobot-swingup", "cartpole-balance", "cartpole-swingup", "cheetah-run"),
    *("hopper-hop", "humanoid-stand", "pendulum-swingup", "reacher-easy"),
    *("swimmer-swimmer6", "walker-run"),
]
GROUND_TRUTH = "dm_control"
ROWS, STEPS = 3, 40

each_task = pytest.mark.parametrize("name", SUITE)


def suite_env(name: str, seed: int = 0):
    return suite.load(*name.split("-", 1), task_kwargs={"random": seed})


def task_id(name: str) -> str:
    return f"dm_control/{name}"


def flat(observation) -> np.ndarray:
    return np.concatenate([np.ravel(part) for part in observation.values()])


def assert_same(got: torch.Tensor, expected, tolerance: float = 1e-6) -> None:
    scale = 1.0 + np.abs(expected).max()
    assert np.abs(got.numpy() - expected).max() <= tolerance * scale


@each_task
def test_ground_truth_is_the_suite_step_for_step(name, seed, generator):
    """From the suite's own resets, of the seeds that the env draws."""
    env = make_env(task_id(name), dynamics=GROUND_TRUTH, num_envs=ROWS, seed=seed)
    state = env.reset()
    u = row_uniforms(seed, torch.zeros(ROWS, dtype=torch.long), 1)[:, 0]
    theirs = [suite_env(name, int(x * 2**32)) for x in u]
    first = [each.reset() for each in theirs]
    assert_same(state["observation"], np.stack([flat(x.observation) for x in first]))
    for action in random_actions(env, STEPS, generator):
        state = act(env, action)
        pairs = zip(theirs, action.double().numpy(), strict=True)
        steps = [each.step(control) for each, control in pairs]
        expected = np.stack([flat(x.observation) for x in steps])
        assert_same(state["observation"], expected)
        assert_same(state["reward"][:, 0], np.array([x.reward for x in steps]))
        assert not state["done"].any()


def test_an_episode_lasts_as_long_as_in_the_suite(seed):
    name = "pendulum-swingup"
    env, theirs = (
        make_env(task_id(name), dynamics=GROUND_TRUTH, seed=seed),
        suite_env(name),
    )
    theirs.reset()
    env.reset()
    idle = torch.zeros(env.action_spec.shape)
    for _ in range(1000):
        step, after = theirs.step(np.zeros(1)), act(env, idle)
        assert bool(after["truncated"]) == step.last()
        assert not after["terminated"].any()
    assert step.last() and step.discount == 1.0


@pytest.mark.parametrize("name", ["cheetah-run", "hopper-hop", "reacher-easy"])
def test_specs_hold_in_learned_and_mujoco_dynamics(name, generator):
    task = make_task(task_id(name))
    check_env_specs(NeRDEnv(task, random_model(task.scene, generator), 2))
    for dynamics in ("mujoco", GROUND_TRUTH):
        check_env_specs(make_env(task, dynamics=dynamics, num_envs=2))


@each_task
def test_a_judgement_depends_on_the_state_alone(name, generator):
    """Not on the rows beside it, nor on what was asked before."""
    task = make_task(task_id(name))
    env = make_env(task, dynamics="mujoco", num_envs=8)
    env.reset()
    path = act_all(env, random_actions(env, 4, generator))
    action = random_actions(env, 1, generator)[0]
    states = path.select("qpos", "qvel", *task.parameters)
    asked = torch.randperm(8, generator=generator)[:3]
    together = task.observation(states), task.reward(states, action, states[:, -1])
    again = copy.deepcopy(task)
    alone = states[asked]
    close = {"rtol": 0.0, "atol": 1e-12}  # products of matrices round by their size
    observed = again.observation(alone)
    torch.testing.assert_close(observed, together[0][asked], **close)
    reward = again.reward(alone, action[asked], alone[:, -1])
    torch.testing.assert_close(reward, together[1][asked], **close)
    assert together[0].shape == (8, 4, task.observation_size)
    assert together[1].shape == task.terminated(states[:, 0]).shape == (8,)


@each_task
def test_resets_follow_the_seed_and_travel(name, generator):
    task = make_task(task_id(name))
    u = torch.rand(5, 1, dtype=torch.float64, generator=generator)
    start = task.initial_state(u)
    sizes = {"qpos": task.scene.model.nq, "qvel": task.scene.model.nv}
    assert {k: v.shape for k, v in start.items()} == {
        k: (5, size) for k, size in (sizes | dict(task.parameters)).items()
    }
    assert len(start["qpos"].unique(dim=0)) == 5
    there = pickle.loads(pickle.dumps(task)).initial_state(u.flip(0))
    assert all(torch.equal(there[key].flip(0), start[key]) for key in start)


def test_feet_feel_in_learned_dynamics_what_mujoco_says(generator):
    """At the state and action that led to it: the suite's own after a step is older."""
    task = make_task("dm_control/hopper-stand")
    ground_truth = make_env(task, dynamics="mujoco", num_envs=32, seed=1)
    ground_truth.reset()
    action = random_actions(ground_truth, 60, generator)
    state = act_all(ground_truth, action)[:, -1]
    assert state["observation"][:, -2:].any(), "no foot on the ground"
    seen = task.observation(dict(state.items()) | {"action": action[-1]})
    theirs = suite_env("hopper-stand")
    theirs.reset()
    for row in range(32):
        with theirs.physics.reset_context():
            theirs.physics.data.qpos[:] = state["qpos"][row]
            theirs.physics.data.qvel[:] = state["qvel"][row]
        theirs.physics.set_control(action[-1, row].double().numpy())
        theirs.physics.forward()
        assert_same(seen[row], flat(theirs.task.get_observation(theirs.physics)))


def test_mujoco_and_dm_control_feel_the_same(seed, generator):
    envs = [
        make_env("dm_control/hopper-stand", dynamics=engine, num_envs=4, seed=seed)
        for engine in ("mujoco", GROUND_TRUTH)
    ]
    states = [env.reset() for env in envs]
    for torque in random_drive(envs[0].scene, 4, 10, generator)[1]:
        pairs = zip(envs, states, strict=True)
        states = [env.dynamics.step(state, torque) for env, state in pairs]
        felt = [state["sensordata"] for state in states]
        assert felt[0].shape == (4, envs[0].scene.model.nsensordata)
        assert_same(felt[0][:, 3:], felt[1][:, 3:].numpy(), 1e-5)  # its two feet


def test_a_held_action_is_the_same_action_again_and_again(seed, generator):
    name = task_id("walker-walk")
    held = make_env(f"{name}/3", dynamics=GROUND_TRUTH, num_envs=2, seed=seed)
    plain = make_env(name, dynamics=GROUND_TRUTH, num_envs=2, seed=seed)
    assert held.task.horizon == 334 and plain.task.horizon == 1000
    for env in (held, plain):
        env.reset()
    for action in random_actions(held, 4, generator):
        state, steps = act(held, action), [act(plain, action) for _ in range(3)]
        assert_same_motion(state, steps[-1], 0.0)


def test_a_model_of_held_actions_is_found_by_its_name(generator, tmp_path):
    scene, held = (load_scene(f"dm_control/cartpole-swingup{x}") for x in ("", "/4"))
    assert held.control_step == pytest.approx(4 * scene.control_step)
    assert Scene.from_dm_control("cartpole", "swingup", hold=4).hash == held.hash
    model = random_model(held, generator)
    save_checkpoint(model, tmp_path, make_card(model))
    assert load_checkpoint(tmp_path).scene.control_step == held.control_step
    env = make_env("dm_control/cartpole-swingup/4", dynamics=tmp_path, num_envs=2)
    assert env.rollout(3).shape == (2, 3) and env.task.horizon == 250
    with pytest.raises(ValueError, match="expected"):
        make_env("dm_control/cartpole-swingup", dynamics=tmp_path)
    for hold in (0, -1):
        with pytest.raises(ValueError, match="with a HOLD from 1 on"):
            Scene.from_dm_control("cartpole", "swingup", hold=hold)


def test_a_model_of_one_task_serves_another_of_the_same_robot(generator, tmp_path):
    scene = load_scene("dm_control/cartpole-balance")
    model = random_model(scene, generator)
    save_checkpoint(model, tmp_path, make_card(model))
    env = make_env("dm_control/cartpole-swingup", dynamics=tmp_path, num_envs=2)
    start = start_at(env, env.reset())
    assert (
        act(env, torch.zeros(2, 1))["observation"].shape == start["observation"].shape
    )
    with pytest.raises(ValueError, match="is for robot 'dm_control/cartpole-balance'"):
        make_env("dm_control/acrobot-swingup", dynamics=tmp_path)


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("dm_control/cheetah-fly", "unknown task in 'dm_control/cheetah-fly'"),
        ("dm_control/cheetah", "unknown task in 'dm_control/cheetah'"),
        (
            "dm_control/cheetah-run/0",
            "a HOLD from 1 on, got 'dm_control/cheetah-run/0'",
        ),
        ("dm_control/cheetah-run/", "expected dm_control/DOMAIN-TASK/HOLD"),
        ("dm_control/lqr-lqr_2_1", "has no time limit: not supported"),
        ("dm_control/point_mass-hard", "changes its robot at every reset"),
    ],
)
def test_what_is_not_supported_is_refused_in_one_sentence(name, sentence):
    with pytest.raises(ValueError, match=sentence) as caught:
        make_env(name, dynamics="mujoco")
    assert "\n" not in str(caught.value)


def test_without_a_model_the_commands_that_make_one_are_named():
    command = "nerd train dm_control.swimmer.*runs.dm_control-swimmer-swimmer6.best"
    with pytest.raises(ValueError, match=command):
        make_env("dm_control/swimmer-swimmer6", dynamics="nerd")


@pytest.mark.parametrize("name", ["dm_control/walker-walk", "dm_control/reacher-easy"])
@pytest.mark.parametrize("batch", [(), (0,), (2, 0), (2, 1)])
def test_resets_and_observations_have_any_batch(name, batch):
    task = make_task(name)
    state = task.initial_state(torch.full((*batch, task.num_uniforms), 0.5).double())
    assert state["qpos"].shape == (*batch, task.scene.model.nq)
    assert task.observation(state).shape == (*batch, task.observation_size)
