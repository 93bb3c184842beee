"""What an env promises whatever the task and the dynamics."""

import pytest
import torch
from dynamics_helpers import (
    DYNAMICS,
    LEARNED,
    TRUE,
    EnvMaker,
    act,
    act_all,
    assert_same_motion,
    each_dynamics,
    random_actions,
    random_model,
    start_at,
)
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from torchrl_nerd import GroundTruthEnv, NeRDEnv, load_scene, make_env
from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.envs.base import SceneEnv
from torchrl_nerd.robots import SCENES, make_task

TASK = "cartpole/swingup"


@each_dynamics
@pytest.mark.parametrize("num_envs", [1, 4])
def test_specs_hold(task_id, dynamics, num_envs, generator):
    env = EnvMaker(task_id, dynamics, generator)(num_envs)
    check_env_specs(env)
    assert env.batch_size == (num_envs,) and env.batch_locked


def test_learned_and_mujoco_envs_have_equal_specs(task_id, generator):
    envs = [EnvMaker(task_id, dynamics, generator)() for dynamics in DYNAMICS]
    for env in envs[1:]:
        for name in ("action", "observation", "reward", "done", "state"):
            spec = f"full_{name}_spec" if name != "observation" else "observation_spec"
            assert getattr(env, spec) == getattr(envs[0], spec), name


@each_dynamics
def test_every_step_records_what_happened(task_id, dynamics, generator):
    """Reward, observation and torque are the task's and controller's own formulas."""
    env = EnvMaker(task_id, dynamics, generator)()
    state = env.reset()
    assert not state["joint_torque"].any() and not state["done"].any()
    for action in random_actions(env, 5, generator):
        torque = env.task.controller(action, state["qpos"], state["qvel"])
        after = act(env, action)
        reward = env.task.reward(state, action, after)[:, None]
        is_end = env.task.terminated(after)[:, None]
        if env.task.frame_skip == 1:
            assert torch.equal(after["joint_torque"], torque)
        assert torch.equal(after["reward"], reward.float())
        assert torch.equal(after["terminated"], is_end)
        assert torch.equal(after["observation"], env.task.observation(after).float())
        assert torch.equal(after["done"], after["terminated"] | after["truncated"])
        state = after


@each_dynamics
def test_an_env_steps_its_dynamics(task_id, dynamics, generator):
    make = EnvMaker(task_id, dynamics, generator)
    env, bare = make(), make().dynamics
    state = env.reset()
    bare.reset(state)
    for action in random_actions(env, 5, generator):
        expected, torque = state, None
        for _ in range(env.task.frame_skip):
            torque = env.task.controller(action, expected["qpos"], expected["qvel"])
            expected = bare.step(expected, torque, state.get("terrain", None))
        state = act(env, action)
        assert torch.equal(state["qpos"], expected["qpos"])
        assert torch.equal(state["qvel"], expected["qvel"])
        assert torch.equal(state["joint_torque"], torque)  # of the last control step


@pytest.mark.parametrize("dynamics", ["streaming", "mujoco"])
def test_a_row_moves_as_it_would_alone(task_id, dynamics, generator):
    make = EnvMaker(task_id, dynamics, generator)
    env = make(5, seed=3)
    start = env.reset()
    actions = random_actions(env, 5, generator)
    together = act_all(env, actions)
    for row in range(5):
        alone = make(1)
        start_at(alone, start[row : row + 1])
        path = act_all(alone, actions[:, row : row + 1])
        tolerance = 0.0 if dynamics in TRUE else 1e-6
        assert_same_motion(path[0], together[row], tolerance)


@pytest.mark.parametrize("dynamics", ["streaming", "mujoco"])
def test_an_episode_is_truncated_at_its_horizon_and_not_before(
    task_id, dynamics, generator
):
    env = EnvMaker(task_id, dynamics, generator, horizon=20)(2)
    env.reset()
    idle = torch.zeros(env.action_spec.shape)
    for step in range(1, env.task.horizon + 1):
        after = act(env, idle)
        assert after["truncated"].all() == after["truncated"].any()
        assert after["truncated"].all() == (step == env.task.horizon)
        assert torch.equal(after["done"], after["terminated"] | after["truncated"])
    assert not env.reset()["done"].any()
    assert not act(env, idle)["truncated"].any()


@pytest.mark.parametrize("dynamics", ["streaming", "mujoco"])
def test_failure_is_terminated_and_not_truncated(dynamics, generator):
    make = EnvMaker("cartpole/swingup", dynamics, generator)
    env = make(3)
    start = env.reset()
    start["qpos"][1, 0] = 4.2  # m, off the rail
    start["qvel"][1] = 0.0
    start_at(env, start)
    after = act(env, torch.zeros(env.action_spec.shape))
    assert after["terminated"][:, 0].tolist() == [False, True, False]
    assert after["done"][:, 0].tolist() == [False, True, False]
    assert not after["truncated"].any()


@each_dynamics
def test_the_terminal_observation_survives_the_automatic_reset(dynamics, generator):
    make = EnvMaker("cartpole/swingup", dynamics, generator)
    env, plain = make(3), make(3)
    start = env.reset()
    start["qpos"][1, 0] = 4.2
    for each in (env, plain):
        start_at(each, start)
    action = random_actions(env, 1, generator)[0]
    expected = act(plain, action)
    record, following = env.step_and_maybe_reset(start.clone().set("action", action))
    assert record["next", "done"][:, 0].tolist() == [False, True, False]
    for key in ("observation", "qpos", "qvel", "reward"):
        assert torch.equal(record["next", key], expected[key])
    assert not following["done"].any()
    kept = torch.tensor([True, False, True])
    assert torch.equal(following["qpos"][kept], expected["qpos"][kept])
    assert following["qpos"][1, 0].abs() <= 1.0
    assert torch.equal(
        following["observation"], env.task.observation(following).float()
    )


def test_a_step_before_the_first_reset_is_refused(generator):
    env = EnvMaker(TASK, "streaming", generator)()
    step = env.rand_action()
    with pytest.raises(RuntimeError, match=r"expected reset\(\) before"):
        env.step(step)
    other = EnvMaker(TASK, "streaming", generator)()
    other.reset()
    env.load_state_dict(other.state_dict())
    env.step(step)  # a restored one goes on


def test_a_first_reset_of_some_envs_alone_is_refused() -> None:
    env = make_env("cartpole/swingup", num_envs=3)
    some = TensorDict({"_reset": torch.tensor([[True], [False], [True]])}, [3])
    with pytest.raises(RuntimeError, match="all envs in the first reset"):
        env.reset(some)
    env.reset()
    assert env.reset(some)["qpos"].isfinite().all()


def test_wrong_action_shape_is_refused_in_one_sentence(generator):
    env = EnvMaker(TASK, "mujoco", generator)(3)
    env.reset()
    size = env.action_spec.shape[-1]
    with pytest.raises(ValueError) as caught:
        act(env, torch.zeros(3, size + 1))
    assert f"(3, {size})" in str(caught.value)
    assert f"(3, {size + 1})" in str(caught.value)


def test_bad_arguments_are_refused_in_one_sentence(generator):
    model = random_model(make_task(TASK).scene, generator, "mlp-4x64")
    for count in (0, -2):
        for make in (
            lambda n: GroundTruthEnv(TASK, num_envs=n),
            lambda n: NeRDEnv(TASK, model, num_envs=n),
            lambda n: make_env(TASK, dynamics="mujoco", num_envs=n),
        ):
            with pytest.raises(ValueError, match=f"of at least 1, got {count}"):
                make(count)
    with pytest.raises(
        ValueError,
        match="unknown dynamics 'newton', expected nerd, hybrid, analytic, mu",
    ):
        make_env(TASK, dynamics="newton")
    with pytest.raises(
        ValueError, match="unknown engine 'warp', expected one of mujoco"
    ):
        GroundTruthEnv(TASK, "warp")
    with pytest.raises(
        ValueError, match=f"unknown task 'swim', expected one of .*{TASK}"
    ):
        make_env("swim", dynamics="mujoco")
    with pytest.raises(ValueError, match="inference"):
        NeRDEnv(TASK, model, inference="batch")
    scenes = [load_scene(name) for name in SCENES]
    other = next(scene for scene in scenes if scene is not make_task(TASK).scene)
    with pytest.raises(
        ValueError, match=f"'{make_task(TASK).scene.name}'.*'{other.name}'"
    ):
        SceneEnv(make_task(TASK), MujocoDynamics(other))


@pytest.mark.parametrize("inference", LEARNED)
def test_make_env_takes_a_task_object_and_a_model(inference, generator):
    model = random_model(make_task(TASK).scene, generator, "mlp-4x64")
    env = NeRDEnv(make_task(TASK), model, 2, inference=inference)
    env.reset()
    assert act(env, torch.zeros(env.action_spec.shape)).batch_size == (2,)
