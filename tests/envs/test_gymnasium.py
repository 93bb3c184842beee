"""Every registered task through Gymnasium, in learned and in MuJoCo."""

import warnings

import gymnasium
import numpy as np
import pytest
import torch
from dynamics_helpers import act, random_model
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import torchrl_nerd.gymnasium
from torchrl_nerd import make_env
from torchrl_nerd.checkpoint import make_card, save_checkpoint
from torchrl_nerd.gymnasium import GymnasiumEnv, GymnasiumVectorEnv
from torchrl_nerd.robots import TASKS, make_task

TASK, ID = "cartpole/swingup", "TorchrlNerd/CartpoleSwingup-v0"
STEPS = 12
gymnasium_id = torchrl_nerd.gymnasium.gymnasium_id


@pytest.fixture(params=["learned", "mujoco"])
def dynamics(request, task_id, tmp_path, generator) -> str:
    """A checkpoint of random weights, and the ground truth."""
    if request.param == "mujoco":
        return "mujoco"
    model = random_model(make_task(task_id).scene, generator)
    return str(save_checkpoint(model, tmp_path / "model", make_card(model)))


def short_task(horizon: int):
    task = make_task(TASK)
    task.horizon = horizon
    return task


def actions_of(env, rng, steps: int = STEPS) -> np.ndarray:
    return rng.uniform(-1.0, 1.0, (steps, *env.action_space.shape)).astype(np.float32)


def test_gymnasium_finds_no_fault(task_id, dynamics):
    env = gymnasium.make(gymnasium_id(task_id), dynamics=dynamics)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of bounds that observations do not have
        check_env(env.unwrapped, skip_render_check=True)
    assert env.spec is not None and env.spec.kwargs["dynamics"] == dynamics


def test_a_vector_env_is_its_rows_in_one_call(task_id, dynamics, seed, rng):
    env = gymnasium.make_vec(
        gymnasium_id(task_id),
        num_envs=3,
        vectorization_mode="vector_entry_point",
        dynamics=dynamics,
    )
    bare = make_env(task_id, dynamics=dynamics, num_envs=3, seed=seed)
    assert isinstance(env, GymnasiumVectorEnv) and env.num_envs == 3
    assert env.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    observation, info = env.reset(seed=seed)
    np.testing.assert_array_equal(observation, bare.reset()["observation"])
    for action in actions_of(env, rng, 3):
        observation, reward, terminated, truncated, info = env.step(action)
        after = act(bare, torch.from_numpy(action))
        assert observation in env.observation_space and not info
        np.testing.assert_array_equal(observation, after["observation"])
        np.testing.assert_array_equal(reward, after["reward"][:, 0])
        np.testing.assert_array_equal(terminated, after["terminated"][:, 0])
        np.testing.assert_array_equal(truncated, after["truncated"][:, 0])
        if (terminated | truncated).any():
            break


def test_one_row_and_many_begin_alike(seed, rng):
    one, many = GymnasiumEnv(TASK, "mujoco"), GymnasiumVectorEnv(TASK, "mujoco", 4)
    first, _ = one.reset(seed=seed)
    together, _ = many.reset(seed=seed)
    np.testing.assert_array_equal(first, together[0])
    action = actions_of(many, rng, 1)[0]
    observation, reward, *_ = one.step(action[0])
    everything = many.step(action)
    np.testing.assert_array_equal(observation, everything[0][0])
    assert reward == everything[1][0]


def test_rows_that_end_begin_anew_at_the_next_step(seed, rng):
    """As Gymnasium's own vector env of single envs does it, to the flag."""
    horizon = 4
    many = GymnasiumVectorEnv(short_task(horizon), "mujoco", 3)
    own = gymnasium.vector.SyncVectorEnv(
        [lambda: GymnasiumEnv(short_task(horizon), "mujoco")],
        autoreset_mode=AutoresetMode.NEXT_STEP,
    )
    for env in (many, own):
        env.reset(seed=seed)
    before = None
    for step, action in enumerate(actions_of(many, rng), 1):
        observation, reward, terminated, truncated, _ = many.step(action)
        expected = own.step(action[:1])
        np.testing.assert_array_equal(observation[:1], expected[0])
        np.testing.assert_allclose(reward[:1], expected[1], rtol=1e-12)
        np.testing.assert_array_equal(terminated[:1], expected[2])
        np.testing.assert_array_equal(truncated[:1], expected[3])
        begins = step % (horizon + 1) == 0
        assert truncated.all() == truncated.any() == (step % (horizon + 1) == horizon)
        assert not reward.any() if begins else reward.all()
        assert before is None or (observation != before).any()
        before = observation
    assert len(np.unique(before, axis=0)) == 3


def test_a_failed_row_alone_begins_anew(rng):
    env = GymnasiumVectorEnv(TASK, "mujoco", 3, seed=0)
    env.reset()
    state = env.env.state
    state["qpos"][1, 0] = 4.2  # m, off the rail
    env.env.reset(state, set_state=True)
    first, second = (env.step(action) for action in actions_of(env, rng, 2))
    assert first[2].tolist() == [False, True, False]
    assert abs(second[0][1, 0]) <= 1.0 and second[1][1] == 0.0
    assert not second[2].any() and not second[3].any()
    kept = [0, 2]
    assert (second[1][kept] != 0.0).all() and (abs(second[0][kept, 0]) < 1.5).all()


def test_unseeded_envs_differ_and_seeded_ones_do_not(seed):
    for make in (GymnasiumEnv, GymnasiumVectorEnv):
        fresh, other = (make(TASK, "mujoco").reset()[0] for _ in range(2))
        assert (fresh != other).any()
        seeded = [make(TASK, "mujoco", seed=seed).reset()[0] for _ in range(2)]
        np.testing.assert_array_equal(*seeded)
        again = make(TASK, "mujoco").reset(seed=seed)[0]
        np.testing.assert_array_equal(again, seeded[0])


def test_any_task_goes_by_its_id():
    name = "dm_control/pendulum-swingup"
    env = gymnasium.make("TorchrlNerd/Task-v0", task=name, dynamics="mujoco")
    assert env.reset(seed=0)[0].shape == (3,)
    assert {gymnasium_id(task) for task in TASKS} < set(gymnasium.registry)
    module = "torchrl_nerd.gymnasium:TorchrlNerd/CartpoleSwingup-v0"
    assert gymnasium.make(module, dynamics="mujoco").reset()[0].shape == (4,)


def test_bad_arguments_are_refused_in_one_sentence():
    with pytest.raises(ValueError, match="unknown dynamics 'newton'"):
        gymnasium.make(ID, dynamics="newton")
    env = GymnasiumEnv(TASK, "mujoco")
    env.reset()
    with pytest.raises(ValueError, match=r"expected an action of shape \(1, 1\)"):
        env.step(np.zeros(2))
