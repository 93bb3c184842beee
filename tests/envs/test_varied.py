"""Envs of a robot with hidden parameters: drawn anew, read by MuJoCo alone, warmed up."""

import pickle

import pytest
import torch
from dynamics_helpers import (
    act_all,
    assert_same_motion,
    double_model,
    random_actions,
    random_mask,
    reset_rows,
    start_at,
    unequal_keys,
)
from tensordict import TensorDict
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_nerd import GroundTruthEnv, NeRDEnv, make_env
from torchrl_nerd.analytic import make_step
from torchrl_nerd.checkpoint import from_pretrained
from torchrl_nerd.configs import DataConfig
from torchrl_nerd.data.generate import generate, load_data
from torchrl_nerd.dynamics import MujocoDynamics, NeRDDynamics
from torchrl_nerd.envs.base import SceneEnv
from torchrl_nerd.evaluation.policy import Policy, make_actor
from torchrl_nerd.keys import JOINT_TORQUE, PARAMETERS, QPOS, QVEL
from torchrl_nerd.robots import load_scene, make_task
from torchrl_nerd.tasks import SceneTask
from torchrl_nerd.training.policy_data import policy_data

ROWS, STEPS = 5, 7
RANGES = {"mass:pole": (0.3, 3.0), "motor": (0.6, 1.4), "delay": (0, 2)}
TASKS = {
    "cartpole": lambda: make_task("cartpole/swingup").vary(RANGES),
    "franka, two steps an action": lambda: make_task("franka/reach").vary(
        {"payload:link7": (0.0, 3.0), "delay": (1, 3)}
    ),
    "scene": lambda: SceneTask(load_scene("double_pendulum").vary({"mass": (0.5, 2)})),
}


@pytest.fixture(params=TASKS)
def task(request):
    return TASKS[request.param]()


def test_specs_hold(task):
    check_env_specs(GroundTruthEnv(task, num_envs=ROWS, seed=0))


def test_every_episode_has_its_own_and_starts_as_it_did(task):
    env = GroundTruthEnv(task, num_envs=ROWS, seed=0)
    many = GroundTruthEnv(task, num_envs=2 * ROWS, seed=0)
    first, again = env.reset(), env.reset()
    seen = torch.cat((first[PARAMETERS], again[PARAMETERS]))
    assert len(seen[:, 0].unique()) == 2 * ROWS
    low, high = torch.tensor(list(task.scene.variation.ranges.values())).double().T
    assert (seen >= low).all() and (seen <= high).all()
    assert torch.equal(many.reset()[:ROWS][PARAMETERS], first[PARAMETERS])
    alike = GroundTruthEnv(task.vary({}), num_envs=ROWS, seed=0)
    assert PARAMETERS not in alike.state_spec.keys()
    assert torch.equal(alike.reset()[QPOS], first[QPOS])


def test_an_env_moves_as_its_parameters_say(task, generator):
    env = GroundTruthEnv(task, num_envs=ROWS, seed=0)
    start = env.reset()
    actions = random_actions(env, STEPS, generator)
    path = act_all(env, actions)
    dynamics, terrain = MujocoDynamics(task.scene), start.get("terrain", None)
    state = start.select(QPOS, QVEL, PARAMETERS)
    dynamics.reset(state)
    for step, action in enumerate(actions):
        for _ in range(task.frame_skip):
            torque = task.controller(action, state[QPOS], state[QVEL])
            state = dynamics.step(state, torque, terrain)
        for key in (QPOS, QVEL, PARAMETERS):
            assert torch.equal(path[:, step][key], state[key])


def test_given_parameters_are_kept_until_the_next_reset(task, generator):
    env = GroundTruthEnv(task, num_envs=ROWS, seed=0)
    start = env.reset().select(*env.state_spec.keys())
    actions = random_actions(env, STEPS, generator)
    expected = act_all(env, actions)
    other = GroundTruthEnv(task, num_envs=ROWS, seed=1)
    start_at(other, start)
    assert not unequal_keys(act_all(other, actions), expected)
    rows = random_mask(ROWS, generator)
    reset_rows(other, rows)
    changed = (other.state[PARAMETERS] != start[PARAMETERS]).any(1)
    assert torch.equal(changed, rows)


def test_the_past_of_a_late_torque_travels(generator):
    """Through pickle, and back in time, in the middle of a motion."""
    scene = load_scene("cartpole").vary({"delay": (2, 2)})
    dynamics, state = MujocoDynamics(scene), scene.sample_initial(ROWS, generator)[0]
    state = TensorDict(
        state | {PARAMETERS: scene.variation.draw(ROWS, generator)}, ROWS
    )
    torques = 1000.0 * torch.rand(6, ROWS, 1, generator=generator).double()
    dynamics.reset(state)
    for torque in torques[:3]:
        state = dynamics.step(state, torque)
    past, twin = dynamics.history(), pickle.loads(pickle.dumps(dynamics))
    paths = []
    for each in (dynamics, twin, dynamics):
        now = state
        for torque in torques[3:]:
            now = each.step(now, torque)
        paths.append(now)
        dynamics.restore(past, torch.ones(ROWS, dtype=torch.bool))
    fresh = MujocoDynamics(scene)
    fresh.reset(state)
    forgotten = fresh.step(state, torques[3])
    assert not unequal_keys(paths[1], paths[0])
    assert not unequal_keys(paths[2], paths[0])
    assert not torch.equal(forgotten[QVEL], dynamics.step(state, torques[3])[QVEL])


@pytest.mark.parametrize("network", ["transformer-2x64", "gru"])
def test_a_warm_env_goes_on_as_if_it_had_seen_the_motion(network, generator):
    """Streamed past and present are one stream; a partial reset forgets for its rows."""
    model = double_model(load_scene("cartpole"), generator, network)
    task = make_task("cartpole/swingup")
    whole, cold, warm = (NeRDEnv(task, model, ROWS, seed=0) for _ in range(3))
    actions = 0.1 * random_actions(whole, 2 * STEPS, generator)
    start = whole.reset()
    path = act_all(whole, actions)
    states = torch.cat((start[:, None].select(QPOS, QVEL), path.select(QPOS, QVEL)), 1)
    history = states[:, :STEPS].clone()
    history[JOINT_TORQUE] = path["joint_torque"][:, :STEPS]
    rows = random_mask(ROWS, generator)
    for env in (cold, warm):
        start_at(TransformedEnv(env), states[:, STEPS])
    warm.warm_up(history)
    assert torch.equal(warm.state[QPOS], states[:, STEPS][QPOS])
    warm.dynamics.reset(warm.state, rows)
    late = [act_all(env, actions[STEPS:]) for env in (cold, warm)]
    assert_same_motion(late[1][~rows], path[~rows][:, STEPS:], 1e-9)
    assert_same_motion(late[1][rows], late[0][rows], 1e-9)
    assert not torch.allclose(late[0][QVEL][~rows], late[1][QVEL][~rows], rtol=1e-6)


@pytest.mark.parametrize("engine", ["dm_control"])
def test_engines_of_one_robot_refuse(engine):
    with pytest.raises(ValueError, match="expected MuJoCo for the varied scene"):
        GroundTruthEnv(make_task("cartpole/swingup").vary(RANGES), engine)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("mass:pole", 0.0),
        ("motor", -1.0),
        ("delay", 3.0),
        ("delay", 0.5),
        ("delay", -1),
    ],
)
def test_parameters_that_no_robot_has_are_refused(name, value):
    env = GroundTruthEnv(make_task("cartpole/swingup").vary(RANGES), num_envs=ROWS)
    td = env.reset()
    td[PARAMETERS][2, list(RANGES).index(name)] = value
    with pytest.raises(ValueError, match=f"a possible '{name}', got {value:g}"):
        env.reset(td, set_state=True)
    td[PARAMETERS] = env.state[PARAMETERS]
    td[PARAMETERS][:, 0] = 20.0  # beyond its range, and possible
    assert (env.reset(td, set_state=True)[PARAMETERS][:, 0] == 20.0).all()


def test_late_torques_and_a_fallback_do_not_go_together():
    task = make_task("cartpole/swingup").vary(RANGES)
    with pytest.raises(ValueError, match="without delay for the guard 'fallback'"):
        NeRDEnv(task, "cartpole-adaptive", guard="fallback")


def test_what_steps_one_robot_is_refused_for_many():
    """It would hand out parameters and step the nominal robot."""
    task = make_task("cartpole/swingup").vary(RANGES)
    for name in ("nerd", "analytic", "unconstrained", "cartpole-mlp"):
        with pytest.raises(ValueError, match=f"got '{name}', which steps one robot"):
            make_env(task, name)
    with pytest.raises(ValueError, match="got 'analytic', which steps one robot"):
        NeRDEnv(task, make_step(task.scene))
    assert PARAMETERS in make_env(task, "cartpole-adaptive").reset()
    other = task.scene.vary({"motor": (0.5, 2.0)})
    for dynamics in (
        NeRDDynamics(from_pretrained("cartpole")),
        MujocoDynamics(load_scene("cartpole")),
        MujocoDynamics(other),
        MujocoDynamics(task.scene.vary(dict(reversed(RANGES.items())))),
    ):
        with pytest.raises(ValueError, match="expected dynamics of the varied scene"):
            SceneEnv(task, dynamics, ROWS)


@pytest.mark.parametrize(
    "name", ["gymnasium/HalfCheetah-v5", "dm_control/walker-walk", "franka/reach_osc"]
)
def test_late_commands_are_those_of_the_recorded_actions(name, generator):
    """Also of actuators with gears, and where an action lasts several control steps."""
    task = make_task(name).vary({"delay": (2, 2)})
    whole, warm = (GroundTruthEnv(task, num_envs=2, seed=0) for _ in range(2))
    actions = random_actions(whole, 6, generator)
    state, seen = whole.reset(), []
    for action in actions[:-1]:
        seen.append(whole.step(state.set("action", action)).clone())
        state = seen[-1]["next"].exclude("reward")
    warm.reset(state, set_state=True)
    warm.warm_up(torch.stack(seen, 1))
    found = [
        env.step(state.select(QPOS).set("action", actions[-1]))["next", QPOS]
        for env in (whole, warm)
    ]
    torch.testing.assert_close(*found, rtol=1e-6, atol=1e-6)
    if name.startswith("gymnasium"):
        told = torch.stack(seen, 1).exclude("action")
        with pytest.raises(ValueError, match="'action' in the history of actuators"):
            warm.warm_up(told)


def not_finite(history, key):
    """A copy with one number that is none."""
    value = history[key].clone()
    value[1, 1, 0] = torch.nan
    return history.clone().set(key, value)


def test_a_recorded_motion_needs_no_parameters_where_a_model_adapts():
    task = make_task("cartpole/swingup").vary(RANGES)
    env = NeRDEnv(task, "cartpole-adaptive", num_envs=2, seed=0)
    path = env.rollout(3, break_when_any_done=False)
    env.warm_up(path.exclude(PARAMETERS))


def test_a_history_that_shows_nothing_is_refused():
    env = GroundTruthEnv(make_task("cartpole/swingup").vary(RANGES), num_envs=2)
    state = env.reset().select(QPOS, QVEL, PARAMETERS)
    history = torch.stack(3 * [state], 1)
    history[JOINT_TORQUE] = torch.zeros(2, 3, 1).double()
    env.warm_up(history)
    for bad, words in (
        (history[:1], "a history of 2 envs and"),
        (history[:, :0], "at least one step"),
        (history[:, 0], "at least one step"),
        (history.exclude("next"), "joint_torque.*got none"),
        (history.exclude(QPOS), "'qpos' in a history"),
        (history.exclude(PARAMETERS), "'parameters' in a history.*got none"),
        (not_finite(history, QPOS), "finite 'qpos' in a history, got NaN"),
        (not_finite(history, JOINT_TORQUE), "finite .*joint_torque.* in a history"),
    ):
        with pytest.raises(ValueError, match=words):
            env.warm_up(bad)


def test_the_fallbacks_mujoco_reads_parameters_in_its_own_order():
    ranges = {"mass:pole": (0.3, 3.0), "motor": (0.6, 1.4)}
    backwards = dict(reversed(ranges.items()))
    scene, task = load_scene("cartpole").vary(ranges), make_task("cartpole/swingup")
    model = from_pretrained("cartpole-mlp", scene)
    NeRDEnv(task.vary(ranges), model, guard="fallback")
    with pytest.raises(ValueError, match="got some of another variation"):
        NeRDEnv(task.vary(backwards), model, guard="fallback")


def test_data_keep_the_order_of_their_parameters(tmp_path):
    ranges = {"mass:pole": (0.3, 3.0), "motor": (0.6, 1.4)}
    one = load_scene("cartpole").vary(ranges)
    other = load_scene("cartpole").vary(dict(reversed(ranges.items())))
    config = DataConfig(trajectories=3, steps=2)
    generate(one, config, tmp_path, quiet=True)
    assert len(load_data(one, tmp_path)) == 3
    with pytest.raises(ValueError, match="give --vary as the data were drawn"):
        load_data(other, tmp_path)
    with pytest.raises(ValueError, match="already holds data with variation"):
        generate(other, config, tmp_path, quiet=True)


def test_data_along_a_policy_keep_the_parameters_of_a_start(generator):
    task = make_task("cartpole/swingup").vary({"mass:pole": (0.3, 3.0)})
    start = GroundTruthEnv(task, num_envs=ROWS, seed=0).reset()
    start[PARAMETERS] = torch.full((ROWS, 1), 2.5, dtype=torch.float64)
    actor = make_actor(Policy((4, 8, 1)))
    data = policy_data(task, actor, ROWS, 3, generator, start=start)
    assert (data[PARAMETERS] == 2.5).all()


def test_a_history_that_ends_with_an_episode_shows_nothing():
    task = make_task("cartpole/swingup").vary(RANGES)
    log = NeRDEnv(task, "cartpole-adaptive", num_envs=3, seed=0).rollout(8)
    log["next", "done"][1:, -1] = True
    found = []
    for history in (log, None):
        env = NeRDEnv(task, "cartpole-adaptive", num_envs=3, seed=0)
        env.reset(log[:, -1]["next"].select(QPOS, QVEL, PARAMETERS), set_state=True)
        if history is not None:
            env.warm_up(history)
        given = env.state.set("action", torch.ones(3, 1))
        found.append(env.step(given)["next", QVEL])
    torch.testing.assert_close(found[0][1:], found[1][1:])
    assert (found[0][0] - found[1][0]).abs().max() > 1e-6


def test_an_action_of_another_width_is_no_history():
    env = GroundTruthEnv("ant/run", num_envs=2, seed=0)
    log = env.rollout(3)
    log["action"] = log["action"][..., :1]
    with pytest.raises(ValueError, match="'action' of width 8 in a history, got 1"):
        env.warm_up(log)


def test_a_history_begins_anew_where_an_episode_ended():
    """As if it held what came after alone."""
    task = make_task("cartpole/swingup").vary(RANGES)
    log = NeRDEnv(task, "cartpole-adaptive", num_envs=3, seed=0).rollout(8)
    log["next", "done"][1:, 3] = True
    found = []
    for history in (log, log[:, 4:]):
        env = NeRDEnv(task, "cartpole-adaptive", num_envs=3, seed=0)
        env.reset(log[:, -1]["next"].select(QPOS, QVEL, PARAMETERS), set_state=True)
        env.warm_up(history)
        given = env.state.set("action", torch.ones(3, 1))
        found.append(env.step(given)["next", QVEL])
    torch.testing.assert_close(found[0][1:], found[1][1:])
    assert (found[0][0] - found[1][0]).abs().max() > 1e-6
