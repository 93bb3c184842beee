"""Every registered task through Gymnasium, in learned and in MuJoCo."""

import warnings

import gymnasium
import imageio.v3 as iio
import numpy as np
import pytest
import torch
from dynamics_helpers import act, random_model
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import RecordEpisodeStatistics, RecordVideo
from gymnasium.wrappers import vector as vector_wrappers

import torchrl_nerd.gymnasium
from torchrl_nerd import make_env
from torchrl_nerd.checkpoint import make_card, save_checkpoint
from torchrl_nerd.envs.rendering import find_gl
from torchrl_nerd.gymnasium import GymnasiumEnv, GymnasiumVectorEnv
from torchrl_nerd.robots import TASKS, make_task

TASK, ID = "cartpole/swingup", "TorchrlNerd/CartpoleSwingup-v0"
STEPS = 12
HAS_GL = find_gl() is not None
has_gl = pytest.mark.skipif(
    not HAS_GL, reason="no OpenGL library works on this machine"
)
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
    """Nor warns, but of bounds that observations do not have, as of its own robots."""
    task = make_task(task_id)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        settings = {"dynamics": dynamics, "height": 32, "width": 32}
        mode = "rgb_array" if HAS_GL else None
        env = gymnasium.make(gymnasium_id(task_id), render_mode=mode, **settings)
        check_env(env.unwrapped, skip_render_check=not HAS_GL)
    own = [str(x.message) for x in caught if "gymnasium" in x.filename.lower()]
    assert all("observation space m" in said and "infinity" in said for said in own)
    assert env.spec is not None and env.spec.kwargs["dynamics"] == dynamics
    assert env.spec.max_episode_steps == task.horizon
    assert env.metadata["render_fps"] == round(1.0 / task.step_size)


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
    spec = gymnasium.envs.registration.EnvSpec.from_json(gymnasium.spec(ID).to_json())
    assert gymnasium.make(
        spec, dynamics="mujoco"
    ).unwrapped.observation_space.shape == (4,)
    module = "torchrl_nerd.gymnasium:TorchrlNerd/CartpoleSwingup-v0"
    assert gymnasium.make(module, dynamics="mujoco").reset()[0].shape == (4,)


def test_a_mask_begins_some_episodes_anew(seed, rng):
    """As Gymnasium's own vector env of single envs, to the flag."""
    many = gymnasium.make_vec(ID, num_envs=3, dynamics="mujoco", max_episode_steps=5)
    own = gymnasium.vector.SyncVectorEnv(
        [lambda: GymnasiumEnv(short_task(5), "mujoco")] * 3
    )
    observation, _ = many.reset(seed=seed)
    own.reset(seed=[seed, seed, seed])
    mask = np.array([True, False, False])
    for step, action in enumerate(actions_of(many, rng, 16)):
        if step in (
            2,
            5,
            9,
        ):  # 5: all have just ended, the first begins before its turn
            before, _ = many.reset(options={"reset_mask": mask})
            expected, _ = own.reset(options={"reset_mask": mask.copy()})
            np.testing.assert_array_equal(before[0], expected[0])
            np.testing.assert_array_equal(before[1:], observation[1:])
            assert (before[0] != observation[0]).any()
        observation, reward, terminated, truncated, _ = many.step(action)
        found = own.step(action)
        np.testing.assert_array_equal(observation[0], found[0][0])
        np.testing.assert_array_equal(terminated, found[2])
        np.testing.assert_array_equal(truncated, found[3])
        np.testing.assert_array_equal(reward == 0.0, found[1] == 0.0)
    many.reset(options={"reset_mask": mask})[0][:] = 7.0
    again, _ = many.reset(options={"reset_mask": mask})
    np.testing.assert_array_equal(again[1:], observation[1:])


@pytest.mark.parametrize("steps", [1, 4])
def test_an_episode_is_as_long_as_asked(steps, rng):
    limit = {"dynamics": "mujoco", "max_episode_steps": steps}
    one = gymnasium.make(ID, **limit)
    many = gymnasium.make_vec(ID, num_envs=2, **limit)
    one.reset(seed=0), many.reset(seed=0)
    assert many.spec.max_episode_steps is not None
    for step, action in enumerate(actions_of(many, rng, steps), 1):
        assert one.step(action[0])[3] == (step == steps)
        assert many.step(action)[3].tolist() == [step == steps] * 2
    task = make_task(TASK)
    GymnasiumVectorEnv(task, "mujoco", max_episode_steps=steps)
    assert task.horizon > 4  # the user's own
    longer = GymnasiumVectorEnv(short_task(steps), "mujoco", max_episode_steps=9)
    assert longer.env.task.horizon == steps  # as TimeLimit around a shorter env


@has_gl
def test_gymnasium_records_videos_and_statistics(tmp_path, seed):
    settings = {
        "dynamics": "mujoco",
        "render_mode": "rgb_array",
        "max_episode_steps": 3,
    }
    settings |= {"height": 32, "width": 48}
    one = RecordVideo(gymnasium.make(ID, **settings), str(tmp_path / "one"))
    one = RecordEpisodeStatistics(one)
    one.reset(seed=seed)
    first = one.render()
    for _ in range(3):
        *_, info = one.step(one.action_space.sample())
    one.close()
    frames = iio.imread(tmp_path / "one" / "rl-video-episode-0.mp4")
    assert frames.shape == (4, 32, 48, 3) and info["episode"]["l"] == 3
    assert abs(frames[0].astype(int) - first).mean() < 8.0

    many = gymnasium.make_vec(ID, num_envs=4, **settings)
    many = vector_wrappers.RecordVideo(many, str(tmp_path / "many"))
    many = vector_wrappers.RecordEpisodeStatistics(many)
    many.reset(seed=seed)
    images = many.render()
    assert len(images) == 4 and all(x.shape == (32, 48, 3) for x in images)
    np.testing.assert_array_equal(images[0], first)
    for _ in range(3):
        *_, info = many.step(many.action_space.sample())
    many.close()
    assert info["episode"]["l"].tolist() == [3] * 4
    frames = iio.imread(tmp_path / "many" / "rl-video-episode-0.mp4")
    assert len(frames) == 4 and frames[0].size == 4 * first.size


@has_gl
@pytest.mark.slow
def test_workers_that_are_spawned_know_the_ids(seed):
    envs = gymnasium.make_vec(
        f"torchrl_nerd.gymnasium:{ID}",
        num_envs=1,
        vectorization_mode="async",
        vector_kwargs={"context": "spawn"},
        **{"dynamics": "mujoco", "render_mode": "rgb_array", "height": 24, "width": 24},
    )
    observation, _ = envs.reset(seed=seed)
    expected, _ = GymnasiumEnv(TASK, "mujoco").reset(seed=seed)
    np.testing.assert_array_equal(observation[0], expected)
    assert [x.shape for x in envs.render()] == [(24, 24, 3)]
    envs.close()


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda env: env.reset(options={"speed": 2}), r"unknown options \['speed'\]"),
        (lambda env: env.reset(options={"reset_mask": [1, 0]}), "reset_mask of bool"),
        (lambda env: env.reset(options={"reset_mask": np.ones(3, bool)}), r"\(3,\)"),
        (lambda env: env.reset(options={"reset_mask": np.zeros(2, bool)}), "0 envs"),
        (
            lambda env: env.reset(seed=1, options={"reset_mask": np.ones(2, bool)}),
            "without a seed",
        ),
        (lambda env: GymnasiumEnv(TASK, "mujoco", "human"), "render mode 'human'"),
        (
            lambda env: GymnasiumEnv(TASK, "mujoco").reset(options={"a": 1}),
            "no options",
        ),
        (
            lambda env: GymnasiumVectorEnv(TASK, "mujoco", max_episode_steps=0),
            "max_episode_steps, a whole number of at least 1, got 0",
        ),
        (
            lambda env: GymnasiumVectorEnv(TASK, "mujoco", max_episode_steps=1.5),
            "max_episode_steps, a whole number of at least 1, got 1.5",
        ),
        (lambda env: env.reset(options={"reset_mask": "all"}), "reset_mask of bool"),
    ],
)
def test_what_is_unknown_is_refused(call, words):
    env = GymnasiumVectorEnv(TASK, "mujoco", 2)
    with pytest.raises(ValueError, match="no reset before"):
        env.reset(options={"reset_mask": np.ones(2, bool)})
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros((2, 1), np.float32))
    env.reset()
    with pytest.raises(ValueError, match=words) as refusal:
        call(env)
    assert "\n" not in str(refusal.value)


def test_without_a_render_mode_there_is_no_image():
    env = GymnasiumEnv(TASK, "mujoco")
    env.reset()
    with pytest.warns(UserWarning, match="render_mode='rgb_array'"):
        assert env.render() is None


def test_bad_arguments_are_refused_in_one_sentence():
    with pytest.raises(ValueError, match="unknown dynamics 'newton'"):
        gymnasium.make(ID, dynamics="newton")
    env = GymnasiumEnv(TASK, "mujoco")
    env.reset()
    with pytest.raises(ValueError, match=r"expected an action of shape \(1, 1\)"):
        env.step(np.zeros(2))
    with pytest.raises(TypeError, match="num_envs"):
        gymnasium.make(ID, num_envs=3)  # one env is not three


def test_arrays_of_any_layout_are_taken():
    """Read-only ones, as JAX's are, and reversed ones."""
    envs = GymnasiumVectorEnv(TASK, "mujoco", num_envs=2, seed=0)
    actions = np.array([[-0.5], [0.5]], np.float32)
    fixed = actions[::-1].copy()
    fixed.setflags(write=False)
    found = []
    for given in (fixed, actions[::-1], fixed.astype(np.float64), fixed.tolist()):
        envs.reset(seed=0)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            found.append(envs.step(given)[0])
    for observation in found[1:]:
        np.testing.assert_array_equal(observation, found[0])
    mask = np.array([True, False])[::-1]
    fresh, _ = envs.reset(options={"reset_mask": mask})
    assert (fresh[0] == found[0][0]).all() and (fresh[1] != found[0][1]).any()
