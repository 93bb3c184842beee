"""Starting from a given state, and taking an env's state elsewhere."""

import copy
import pickle

import pytest
import torch
from dynamics_helpers import (
    LEARNED,
    MODELS,
    EnvMaker,
    act_all,
    assert_same_motion,
    each_dynamics,
    random_actions,
    random_drive,
    random_mask,
    reset_rows,
    start_at,
    unequal_keys,
)
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.envs import SerialEnv, StepCounter, TransformedEnv

from torchrl_nerd import make_env
from torchrl_nerd.envs import StatelessEnv
from torchrl_nerd.envs.frame_stack import stack_frames

ROWS, STEPS = 4, 3


def random_state(env, generator) -> TensorDict:
    """A state of the scene's training ranges, far from the task's resets."""
    state, _, terrain = random_drive(env.scene, ROWS, 1, generator)
    for key, width in env.task.parameters.items():
        state[key] = torch.rand(ROWS, width, generator=generator).double()
    if terrain is not None:
        state["terrain"] = terrain
    return state


@each_dynamics
def test_an_env_starts_where_it_is_told(task_id, dynamics, generator):
    make = EnvMaker(task_id, dynamics, generator)
    env, other = make(ROWS, seed=0), make(ROWS, seed=1)
    state = random_state(env, generator)
    other.reset()
    act_all(other, random_actions(env, STEPS, generator))
    for each in (env, other):
        given = each.reset(state.clone(), set_state=True)
        for key, value in state.items():
            assert torch.equal(given[key], value)
        expected = each.task.observation(state).float()
        assert torch.equal(given["observation"], expected)
        assert not given["done"].any()
    actions = random_actions(env, STEPS, generator)
    assert not unequal_keys(act_all(env, actions), act_all(other, actions))


@each_dynamics
def test_a_mask_says_which_rows_are_set(task_id, dynamics, generator):
    make = EnvMaker(task_id, dynamics, generator)
    env, undisturbed = make(ROWS), make(ROWS)
    actions = random_actions(env, 2 * STEPS, generator)
    for each in (env, undisturbed):
        each.reset()
        before = act_all(each, actions[:STEPS])[:, -1]
    rows = random_mask(ROWS, generator)
    state = random_state(env, generator)
    given = state.clone().set("_reset", rows[:, None])
    given["qpos"][~rows] = torch.nan  # what stands in other rows is nobody's business
    after = env.reset(given, set_state=True)
    assert torch.equal(after["qpos"][rows], state["qpos"][rows])
    assert torch.equal(env.state["qpos"][~rows], before["qpos"][~rows])
    path, expected = (act_all(each, actions[STEPS:]) for each in (env, undisturbed))
    assert not unequal_keys(path[~rows], expected[~rows])
    fresh = make(ROWS)
    start_at(fresh, state)
    expected = act_all(fresh, actions[STEPS:])
    tolerance = 1e-6 if dynamics == "streaming" else 0.0
    assert_same_motion(path[rows], expected[rows], tolerance)


@pytest.mark.parametrize("dynamics", ["streaming", "mujoco"])
def test_parameters_that_are_not_given_are_drawn(task_id, dynamics, generator):
    env = EnvMaker(task_id, dynamics, generator)(ROWS)
    state = random_state(env, generator).select("qpos", "qvel")
    after = env.reset(state, set_state=True)
    for key, size in env.task.parameters.items():
        assert after[key].shape == (ROWS, size) and after[key].isfinite().all()
        assert after[key].any(-1).all()


def test_bad_states_are_refused_in_one_sentence(task_id, generator):
    env = EnvMaker(task_id, "mujoco", generator)(ROWS)
    before = env.reset()
    state = random_state(env, generator)
    nq = env.scene.model.nq

    def message(given: TensorDict | None) -> str:
        with pytest.raises(ValueError) as caught:
            env.reset(given, set_state=True)
        assert "\n" not in str(caught.value)
        return str(caught.value)

    for key in ("qpos", "qvel"):
        assert key in message(state.exclude(key))
    assert "qpos" in message(None)
    said = message(state.clone().set("qpos", torch.zeros(ROWS, nq + 1)))
    assert f"qpos of shape ({ROWS}, {nq})" in said and f"({ROWS}, {nq + 1})" in said
    for key in state.keys():
        for junk in (torch.nan, torch.inf):
            wrong = state.clone()
            wrong[key][1, 0] = junk
            assert f"finite {key}" in message(wrong)
    assert torch.equal(env.state["qpos"], before["qpos"])  # and nothing has changed


@each_dynamics
def test_state_dict_restores_the_physical_state(task_id, dynamics, generator):
    make = EnvMaker(task_id, dynamics, generator)
    env, other = make(ROWS, seed=5), make(ROWS, seed=6)
    actions = random_actions(env, 2 * STEPS, generator)
    env.reset()
    act_all(env, actions[:STEPS])
    reset_rows(env, random_mask(ROWS, generator))
    other.reset()
    other.load_state_dict(copy.deepcopy(env.state_dict()))
    assert not unequal_keys(other.state, env.state)
    if dynamics not in LEARNED:
        after, expected = (act_all(each, actions[STEPS:]) for each in (other, env))
        assert_same_motion(after, expected, 1e-9)  # a solver's warm start is no state
    again, expected = (each.reset() for each in (other, env))
    assert torch.equal(again["qpos"], expected["qpos"]) and other.seed == 5


@each_dynamics
def test_state_dict_leaves_no_history_of_another_life(task_id, dynamics, generator):
    """What a row saw before a state was loaded does not move it afterwards."""
    make = EnvMaker(task_id, dynamics, generator)
    used, fresh, source = (make(ROWS, seed=5) for _ in range(3))
    actions = random_actions(used, 2 * STEPS, generator)
    used.reset()
    act_all(used, actions[:STEPS])
    fresh.reset()
    start_at(source, random_state(source, generator))
    for each in (used, fresh):
        each.load_state_dict(copy.deepcopy(source.state_dict()))
    after, expected = (act_all(each, actions[STEPS:]) for each in (used, fresh))
    assert_same_motion(after, expected, 1e-6)


@each_dynamics
@pytest.mark.parametrize(
    "way", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))]
)
def test_a_copied_env_lives_a_life_of_its_own(task_id, dynamics, way, generator):
    make = EnvMaker(task_id, dynamics, generator)
    env, expected = make(ROWS), make(ROWS)
    actions = random_actions(env, STEPS, generator)
    for each in (env, expected):
        each.reset()
    twin = way(env)
    copied, path = act_all(twin, actions), act_all(env, actions)
    wanted = act_all(expected, actions)
    assert not unequal_keys(copied, wanted) and not unequal_keys(path, wanted)


@pytest.mark.parametrize("dynamics", ["streaming", "mujoco"])
@pytest.mark.parametrize(
    "wrap",
    [
        lambda make: TransformedEnv(make(ROWS), StepCounter()),
        lambda make: stack_frames(make(ROWS), 3),
        lambda make: SerialEnv(1, lambda: make(ROWS)),
    ],
    ids=["transformed", "frames", "serial"],
)
def test_a_wrapped_env_starts_where_it_is_told(task_id, dynamics, wrap, generator):
    make = EnvMaker(task_id, dynamics, generator)
    env, plain = wrap(make), make(ROWS)
    state = random_state(plain, generator)
    action = random_actions(plain, 1, generator)[0]
    shape = env.batch_size
    after = env.reset(state.clone().reshape(shape), set_state=True)
    path = env.rollout(
        2,
        lambda td: td.set("action", action.reshape(*shape, -1)),
        tensordict=state.clone().reshape(shape),
        set_state=True,
    )
    plain.reset(state.clone(), set_state=True)
    expected = act_all(plain, action[None])[:, 0]
    for key, value in state.items():
        assert torch.equal(after[key].reshape(value.shape), value)
    got = path.reshape(ROWS, -1)[:, 0]["next"]
    assert torch.equal(got["qpos"], expected["qpos"])
    if not isinstance(env, SerialEnv):  # a state that is only there is not set
        assert (env.reset(state.clone())["qpos"] != state["qpos"]).any(-1).all()


@each_dynamics
@pytest.mark.parametrize("task_id", ["ant/run", "cube/toss"])
def test_quaternions_of_any_length_stand_for_unit_ones(task_id, dynamics, generator):
    env = EnvMaker(task_id, dynamics, generator)(ROWS)
    unit, q = random_state(env, generator), env.scene.base.qpos_address
    scaled, torque = unit.clone(), torch.zeros(ROWS, len(env.scene.actuated))
    scaled["qpos"][:, q + 3 : q + 7] *= torch.tensor([[1.0], [0.6], [2.5], [1 + 1e-9]])
    after = env.reset(scaled.clone(), set_state=True)
    torch.testing.assert_close(after["qpos"], unit["qpos"], atol=1e-15, rtol=1e-15)
    ends = []
    for state in (unit, scaled):
        env.dynamics.reset(state)
        given = state.select("qpos", "qvel")
        ends.append(env.dynamics.step(given, torque, state.get("terrain", None)))
    assert_same_motion(*ends, 1e-9 if dynamics in MODELS else 1e-12)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("task_id", ["cube_slope/toss", "double_pendulum/passive"])
def test_normals_of_any_length_stand_for_unit_ones(task_id, dtype, generator):
    """The offset is a distance, m, along the normal; a unit normal stays as it is."""
    env = make_env(task_id, "mujoco", ROWS, state_dtype=dtype)
    unit = random_state(env, generator)
    assert torch.equal(
        env.reset(unit, set_state=True)["terrain"], unit["terrain"].to(dtype)
    )
    scaled = unit.clone()
    scaled["terrain"][:, :3] *= torch.tensor([[1.0], [0.6], [2.5], [1 + 1e-9]])
    after = env.reset(scaled, set_state=True)["terrain"]
    torch.testing.assert_close(after, unit["terrain"].to(dtype))
    before = env.state
    for row in range(2):
        scaled["terrain"][row, :3] = 0.0
        given = scaled.clone().set("_reset", torch.tensor([[False], *3 * [[True]]]))
        if row == 0:  # what stands in other rows is nobody's business
            assert env.reset(given, set_state=True)["terrain"].isfinite().all()
        else:
            with pytest.raises(ValueError, match="with a length, got zero"):
                env.reset(given, set_state=True)
    assert torch.equal(env.state["terrain"], before["terrain"])


@pytest.mark.parametrize("dynamics", ["streaming", "mujoco"])
def test_a_collector_goes_on_from_its_state_dict(dynamics, generator):
    env = EnvMaker("cartpole/swingup", dynamics, generator)(ROWS)
    size, actions = env.observation_spec["observation"].shape[-1], env.action_spec
    net = torch.nn.Linear(size, actions.shape[-1])
    policy = TensorDictModule(net, ["observation"], ["action"])
    collector = Collector(env, policy, frames_per_batch=12, total_frames=36)
    before = next(iter(collector))
    collector.load_state_dict(collector.state_dict())
    assert torch.equal(env.state["qpos"], before["next", "qpos"][:, -1])
    collector.shutdown()


@pytest.mark.parametrize("dynamics", ["streaming", "mujoco"])
def test_one_state_that_is_loaded_changes_no_other(dynamics, generator):
    """As where a planner goes back and forth between two."""
    env = EnvMaker("cartpole/swingup", dynamics, generator)(ROWS)
    actions, saved = random_actions(env, STEPS, generator), []
    env.reset()
    for action in actions:
        act_all(env, action[None])
        saved.append((env.state_dict(), env.state))
    for kept, state in (*saved, *saved):
        env.load_state_dict(kept)
        assert not unequal_keys(env.state, state)


def test_an_empty_state_leaves_the_history(generator):
    make = EnvMaker("cartpole/swingup", "streaming", generator)
    actions, ends = random_actions(make(ROWS), 2 * STEPS, generator), []
    for is_loaded in (False, True):
        env = make(ROWS)
        env.reset()
        act_all(env, actions[:STEPS])
        if is_loaded:
            env.load_state_dict({})
        ends.append(act_all(env, actions[STEPS:]))
    assert not unequal_keys(*ends)


def test_an_env_inside_a_module_is_restored_too(generator):
    make = EnvMaker("cartpole/swingup", "mujoco", generator)
    one, other = (StatelessEnv(make(ROWS, seed=seed)) for seed in (5, 6))
    one.reset()
    other.load_state_dict(one.state_dict())
    assert torch.equal(one.reset()["qpos"], other.reset()["qpos"])


def test_a_whole_state_draws_no_start():
    """A suite task draws one env by env, in Python."""
    env = make_env("dm_control/cheetah-run", "mujoco", num_envs=ROWS, seed=0)
    state = env.reset().select("qpos", "qvel")

    def fail(u):
        raise AssertionError("a start was drawn")

    env.task.initial_state = fail
    after = env.reset(state.clone(), set_state=True)
    assert all(torch.equal(after[key], state[key]) for key in ("qpos", "qvel"))
