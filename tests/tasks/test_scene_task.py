"""An env of a robot alone: its state, no reward, starts as in training."""

import pytest
import torch
from dynamics_helpers import random_model
from torchrl.envs.utils import check_env_specs

from torchrl_nerd import load_scene, make_env
from torchrl_nerd.checkpoint import make_card, save_checkpoint
from torchrl_nerd.envs.dm_environment import DmEnvironment
from torchrl_nerd.gymnasium import GymnasiumEnv
from torchrl_nerd.robots import SCENES, task_id
from torchrl_nerd.tasks import SceneTask

ROBOT = """<mujoco><option timestep="0.01"/><worldbody><geom type="plane" size="1 1 1"/>
  <body pos="0 0 1"><joint name="a" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.05"/></body></worldbody>
  <actuator><motor joint="a" gear="2"/></actuator></mujoco>"""


@pytest.fixture
def path(tmp_path):
    (tmp_path / "robot.xml").write_text(ROBOT)
    return str(tmp_path / "robot.xml")


def test_a_robots_file_is_an_env_in_every_dynamics(path, tmp_path, generator):
    model = random_model(load_scene(path), generator)
    folder = save_checkpoint(model, tmp_path / "model", make_card(model))
    for dynamics in ("mujoco", "dm_control", str(folder), folder):
        env = make_env(path, dynamics, num_envs=3, seed=1)
        check_env_specs(env)
        assert env.scene is load_scene(path) and task_id(env.task) == path
        found = env.rollout(4, break_when_any_done=False)["next"]
        state = torch.cat((found["qpos"], found["qvel"]), -1)
        assert torch.equal(found["observation"], state.float())
        assert not found["reward"].any() and not found["terminated"].any()


@pytest.mark.parametrize("dynamics", ["mujoco", "cartpole-adaptive"])
def test_a_scene_is_the_env_of_its_scene_task(dynamics):
    scene = load_scene("cartpole").vary({"mass:pole": (0.5, 2.0)})
    env = make_env(scene, dynamics, num_envs=2, seed=0)
    assert type(env.task) is SceneTask and env.scene is scene
    assert env.rollout(3)["next", "qpos"].isfinite().all()


def test_a_scene_is_an_env_of_gymnasium_and_dm_env():
    scene = load_scene("cartpole")
    assert GymnasiumEnv(scene, "mujoco").reset(seed=0)[0].shape == (4,)
    assert DmEnvironment(scene, "mujoco").reset().observation.shape == (4,)


def test_a_subclass_gives_the_robot_a_reward(path):
    class Spin(SceneTask):
        """Reward: speed of the joint."""

        def reward(self, state, action, next_state):
            return next_state["qvel"][..., 0]

    env = make_env(Spin(load_scene(path)), "mujoco", num_envs=2)
    found = env.rollout(3)["next"]
    assert task_id(env.task) == "Spin" and found["reward"].any()
    assert torch.equal(found["reward"], found["qvel"].float())


def test_an_episode_ends_by_its_horizon(path):
    env = make_env(path, "mujoco")
    env.task.horizon = 5
    flags = env.rollout(9)["next"]
    assert flags["truncated"].flatten().tolist() == [False] * 4 + [True]


@pytest.mark.parametrize("name", SCENES)
def test_starts_are_those_of_the_training_data(name):
    scene, u = load_scene(name), torch.tensor([[0.25], [1.0 - 2.0**-53]]).double()
    starts = SceneTask(scene).initial_state(u)
    expected, _ = scene.sample_initial(4096, torch.Generator().manual_seed(0))
    assert starts.keys() == expected.keys()
    for key, value in starts.items():
        assert torch.equal(value, expected[key][[1024, 4095]]), key


def test_a_suite_task_stays_the_suites():
    assert task_id(make_env("dm_control/pendulum-swingup", "mujoco").task) == (
        "dm_control/pendulum-swingup"
    )
    with pytest.raises(ValueError, match="found none at nowhere.xml"):
        make_env("nowhere.xml", "mujoco")


def test_starts_are_those_of_the_ground_that_it_is_given():
    """A ground of each env, and one of all."""
    slope, level = load_scene("cube_slope"), load_scene("cube")
    there = make_env(SceneTask(level).with_scene(slope), "mujoco", 2).rollout(2)
    back = make_env(SceneTask(slope).with_scene(level), "mujoco", 2).rollout(2)
    assert "terrain" in there.keys() and "terrain" not in back.keys()
