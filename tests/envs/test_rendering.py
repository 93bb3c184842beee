"""Images show the robot where its state says, in every dynamics, on its own terrain."""

import copy
import multiprocessing
import pickle
from concurrent.futures import ThreadPoolExecutor

import mujoco
import numpy as np
import pytest
import torch
from dynamics_helpers import EnvMaker, each_dynamics
from helpers import FLOATER, make_scene
from tensordict import TensorDict
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import check_env_specs
from torchrl.record import CSVLogger, PixelRenderTransform, VideoRecorder

from torchrl_nerd import make_env
from torchrl_nerd.envs.base import SceneEnv
from torchrl_nerd.envs.rendering import Renderer, find_gl
from torchrl_nerd.keys import GOAL, QPOS, TARGET, TERRAIN
from torchrl_nerd.robots import make_task
from torchrl_nerd.scenes import Scene
from torchrl_nerd.tasks import Task

HEIGHT, WIDTH = SIZE = (96, 120)
SMALL = {"height": HEIGHT, "width": WIDTH}
ROWS, HORIZON = 2, 4


@pytest.fixture(autouse=True)
def gl(request: pytest.FixtureRequest) -> None:
    if find_gl() is None and "without_opengl" not in request.node.name:
        pytest.skip("no OpenGL library works on this machine")


class Still(Task):
    """A task of any scene, with a marker in its images."""

    horizon, num_uniforms, observation_size = 10, 1, 1

    def __init__(self, scene: Scene) -> None:
        self._given = scene

    def build_scene(self) -> Scene:
        return self._given

    def initial_state(self, u):
        model = self.scene.model
        qpos = torch.from_numpy(model.qpos0).expand(*u.shape[:-1], -1)
        return {QPOS: qpos.clone(), "qvel": qpos.new_zeros(*u.shape[:-1], model.nv)}

    def observation(self, state):
        return state[QPOS][..., :1]

    def show(self, model, data, state):
        model.geom_rgba[:] = (0.1, 0.9, 0.1, 1.0)


def differs(a: np.ndarray, b: np.ndarray, by: int = 40) -> float:
    """Share of pixels that are not alike."""
    return (abs(a.astype(int) - b).max(-1) > by).mean()


@each_dynamics
def test_every_task_in_every_dynamics_has_images(task_id, dynamics, generator):
    make = EnvMaker(task_id, dynamics, generator, HORIZON)
    env, unseen = make(ROWS), make(ROWS)
    for each in (env, unseen):
        each.reset()
    first = env.render(**SMALL)
    assert first.shape == (ROWS, *SIZE, 3) and first.dtype == np.uint8
    is_colored = np.ptp(first.astype(int), -1) > 60  # robots are, grounds are gray
    assert ((0.001 < is_colored.mean((1, 2))) & (is_colored.mean((1, 2)) < 0.5)).all()
    assert differs(*first) > 0.001  # each env has its own
    np.testing.assert_array_equal(env.render(1, **SMALL), first[:1])
    assert env.render().shape == (ROWS, 240, 320, 3)
    actions = torch.ones(3, *env.action_spec.shape)
    for action in actions:  # drawing changes nothing
        stepped = [
            each.step(TensorDict({"action": action}, each.batch_size))
            for each in (env, unseen)
        ]
        assert torch.equal(*(td["next", QPOS] for td in stepped))
        env.render(**SMALL)
    expected = Renderer(env.task)(env.state, *SIZE)
    np.testing.assert_array_equal(env.render(**SMALL), expected)
    assert (env.render(**SMALL) != first).any()


@pytest.mark.parametrize("task_id", ["ant/run", "dm_control/cheetah-run", "mine"])
def test_pixels_are_an_observation_like_any_other(task_id, seed):
    task = Still(make_scene(FLOATER)) if task_id == "mine" else task_id
    how = {"dynamics": "mujoco", "num_envs": ROWS, "seed": seed, "from_pixels": True}
    env = make_env(task, **how, render_size=(32, 48))
    plain = make_env(task, dynamics="mujoco", num_envs=ROWS, seed=seed)
    check_env_specs(env)
    env.set_seed(seed)
    start, expected = env.reset(), plain.reset()
    assert torch.equal(start[QPOS], expected[QPOS])
    assert start["pixels"].shape == (ROWS, 32, 48, 3)
    after = env.step(start.set("action", torch.ones(env.action_spec.shape)))["next"]
    np.testing.assert_array_equal(after["pixels"], env.render())
    assert (after["pixels"] != start["pixels"]).any()
    rows = torch.tensor([[True], [False]])
    begun = env.reset(after.exclude("reward").set("_reset", rows))
    np.testing.assert_array_equal(begun["pixels"], env.render())
    assert torch.equal(begun["pixels"][1], after["pixels"][1])

    alone = make_env(task, **how, pixels_only=True, render_size=32)
    check_env_specs(alone)
    assert set(alone.reset().keys()) == {"pixels", "done", "terminated", "truncated"}
    assert (alone.rollout(3)["next", "pixels"].shape) == (ROWS, 3, 32, 32, 3)
    env.reset(alone.state, set_state=True)
    assert torch.equal(env.state[QPOS], alone.state[QPOS])


def test_torchrl_records_a_video(tmp_path, seed):
    logger = CSVLogger("a", log_dir=str(tmp_path))
    env = make_env("ant/run", "mujoco", num_envs=ROWS, seed=seed)
    steps = Compose(PixelRenderTransform(**SMALL), VideoRecorder(logger, "video"))
    env = TransformedEnv(env, steps)
    check_env_specs(env)
    env.transform.dump()
    rollout = env.rollout(3)
    env.transform.dump()
    (file,) = tmp_path.rglob("video_1.pt")
    video = torch.load(file)[0]  # (time, color, height, envs beside each other)
    assert len(video) == 4
    for i in range(ROWS):
        seen = video[1:, :, :, i * WIDTH : (i + 1) * WIDTH].permute(0, 2, 3, 1)
        assert torch.equal(seen, rollout["next", "pixels"][i])


@pytest.mark.parametrize("name", ["cheetah-run", "reacher-easy"])
def test_a_suite_task_looks_as_in_mujoco(name, seed):
    """From the suite's camera, with its target."""
    env = make_env(f"dm_control/{name}", "mujoco", num_envs=ROWS, seed=seed)
    env.reset()
    images, state, model = env.render(**SMALL), env.state, copy.copy(env.scene.model)
    model.vis.quality.offsamples = 0
    for i in range(ROWS):
        if TARGET in state.keys():
            model.geom("target").pos = state[TARGET][i]
        data = mujoco.MjData(model)
        data.qpos = state[QPOS][i]
        mujoco.mj_forward(model, data)
        with mujoco.Renderer(model, *SIZE) as renderer:
            renderer.update_scene(data, camera=0)
            renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
            expected = renderer.render()
        assert differs(images[i], expected) < 0.005
        assert differs(images[i], env.render(camera_id=-1, **SMALL)[i]) > 0.02


def test_the_camera_follows_a_floating_base(generator):
    task = make_task("ant/run")
    qpos = task.scene.sample_initial(1, generator)[0][QPOS].expand(3, -1).clone()
    qpos[1, :2] += torch.tensor((40.0, -20.0))  # whole squares of the ground
    qpos[2, 7:] += 0.5
    here, moved, turned = Renderer(task)({QPOS: qpos}, *SIZE)
    assert differs(here, moved) < 0.01 < differs(here, turned)


@pytest.mark.parametrize("task_id", ["cube_slope/toss", "double_pendulum/passive"])
def test_the_terrain_of_an_env_is_where_its_parameters_say(task_id, generator):
    task, renderer = make_task(task_id), Renderer(make_task(task_id))
    qpos = task.scene.sample_initial(1, generator)[0][QPOS]
    terrain = torch.tensor([(0.3, 0.0, 0.91**0.5, -0.2)], dtype=torch.float64)
    (image,) = renderer({QPOS: qpos, TERRAIN: terrain}, *SIZE)
    (plane,) = np.flatnonzero(task.scene.model.geom_type == 0)
    normal = renderer._data.geom_xmat[plane].reshape(3, 3)[:, 2]
    np.testing.assert_allclose(normal, terrain[0, :3], atol=1e-9)
    np.testing.assert_allclose(normal @ renderer._data.geom_xpos[plane], -0.2)
    level = torch.tensor([(0.0, 0.0, 1.0, -0.2)], dtype=torch.float64)
    assert differs(image, renderer({QPOS: qpos, TERRAIN: level}, *SIZE)[0], 20) > 0.02


def test_a_goal_is_seen(seed):
    env = make_env("franka/reach", "mujoco", num_envs=ROWS, seed=seed)
    env.reset()
    state = env.state
    state[QPOS][:] = state[QPOS][0]
    first, second = Renderer(env.task)(state)
    red = [
        (x[..., 0] > 1.5 * x[..., 2]) & (x[..., 1] < 0.5 * x[..., 0])
        for x in (first, second)
    ]
    assert 10 < red[0].sum() < 500 and 10 < red[1].sum() < 500
    assert 0.0 < differs(first, second) < 0.01
    same = Renderer(env.task)(state.exclude(GOAL))
    np.testing.assert_array_equal(same[0], same[1])


def test_a_task_puts_its_own_things_into_the_image():
    scene = make_scene(FLOATER)
    before = scene.model.stat.extent, scene.model.geom_rgba.copy()
    env = make_env(Still(scene), "mujoco", render_size=SIZE)
    env.reset()
    (image,) = env.render()
    green = (image[..., 1] > 2 * image[..., 0].astype(int)).mean()
    assert green > 0.1
    assert scene.model.stat.extent == before[0]  # the scene itself stays as it is
    np.testing.assert_array_equal(scene.model.geom_rgba, before[1])


def _draw_into(env: SceneEnv, pipe) -> None:
    try:
        env.render()
    except ValueError as refusal:
        pipe.send(str(refusal))


def test_copies_draw_the_same_and_forked_processes_refuse():
    env = make_env("cartpole/swingup", "mujoco", render_size=SIZE, seed=0)
    env.reset()
    unseen = set(env.state_dict()), len(pickle.dumps(env))
    expected = env.render()
    assert (set(env.state_dict()), len(pickle.dumps(env))) == unseen
    for other in (copy.deepcopy(env), pickle.loads(pickle.dumps(env))):
        np.testing.assert_array_equal(other.render(), expected)
        other.close()
    np.testing.assert_array_equal(env.render(), expected)
    context = multiprocessing.get_context("fork")
    here, there = context.Pipe()
    process = context.Process(target=_draw_into, args=(env, there), daemon=True)
    process.start()  # of drivers that are in use already, and hang in a forked process
    assert here.poll(60.0) and "expected a process started with 'spawn'" in here.recv()
    process.join()
    assert process.exitcode == 0
    np.testing.assert_array_equal(env.render(), expected)


def test_threads_draw_the_same(seed):
    env = make_env("cartpole/swingup", "mujoco", render_size=SIZE, seed=seed)
    env.reset()
    expected = env.render()
    with ThreadPoolExecutor(2) as pool:
        found = [pool.submit(env.render).result() for _ in range(3)]
        pool.submit(env.close).result()
    for image in (*found, env.render()):
        np.testing.assert_array_equal(image, expected)


def test_threads_share_an_env_that_they_draw(seed):
    env = make_env("cartpole/swingup", "mujoco", render_size=SIZE, seed=seed)
    env.reset()
    expected = env.render()
    with pytest.raises(ValueError, match="nose"):
        env.render(camera_id="nose")  # which must leave no context to this thread
    with ThreadPoolExecutor(4) as pool:
        for found in [pool.submit(env.render) for _ in range(32)]:
            np.testing.assert_array_equal(found.result(), expected)


def test_what_images_need_is_made_late_and_freed():
    env, other = (
        make_env("cartpole/swingup", "mujoco", render_size=SIZE, seed=0)
        for _ in range(2)
    )
    assert not env._renderer._gl
    env.reset(), other.reset()
    first = env.render()
    expected = other.render(), other.render(height=24, width=24)
    env.close()
    assert not env._renderer._gl
    for image, again in zip(expected, (SIZE, (24, 24)), strict=True):
        now = other.render(height=again[0], width=again[1])
        np.testing.assert_array_equal(now, image)
    np.testing.assert_array_equal(env.render(), first)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"num_envs": 0}, "num_envs, a whole number of at least 1, got 0"),
        ({"num_envs": 1.5}, "num_envs, a whole number of at least 1, got 1.5"),
        ({"num_envs": 9}, "at most 1 envs, got 9"),
        ({"height": 0}, "height, a whole number of at least 1, got 0"),
        ({"width": 2.5}, "width, a whole number of at least 1, got 2.5"),
        ({"camera_id": "nose"}, "nose"),
        ({"camera_id": 5}, "5"),
    ],
)
def test_bad_input_is_refused(given, words):
    env = make_env("dm_control/cheetah-run", "mujoco", render_size=SIZE)
    env.reset()
    with pytest.raises(ValueError, match=words):
        env.render(**given)
    for size in ((4, 0), (4.0, 4), 2.5, "4", (4,), (4, 4, 3)):
        with pytest.raises(ValueError, match=r"a whole number of|height and width"):
            make_env("ant/run", "mujoco", render_size=size)
    with pytest.raises(ValueError, match="expected from_pixels=True"):
        make_env("ant/run", "mujoco", pixels_only=True)


def test_a_machine_without_opengl_is_told_what_to_install(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "off")
    assert find_gl() is None
    env = make_env("ant/run", "mujoco")
    env.reset()
    with pytest.raises(ValueError, match="MUJOCO_GL .* got 'off': unset it") as refusal:
        env.render()
    assert "\n" not in str(refusal.value)
    monkeypatch.delenv("MUJOCO_GL")
    monkeypatch.setattr("torchrl_nerd.envs.rendering._renders", lambda name: False)
    with pytest.raises(ValueError, match="install libegl1"):
        env.render()
