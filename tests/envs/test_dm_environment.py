"""dm_env's own tests of an environment, for every task in learned and MuJoCo."""

import dm_env
import numpy as np
import pytest
import torch
from absl.testing import absltest
from dm_control import suite
from dm_env import test_utils
from dynamics_helpers import act, random_model

from torchrl_nerd import make_env
from torchrl_nerd.checkpoint import make_card, save_checkpoint
from torchrl_nerd.envs.dm_environment import DmEnvironment
from torchrl_nerd.robots import TASKS, make_task

HORIZON = 6


class Contract(test_utils.EnvironmentTestMixin):
    """Episodes short enough that the tests meet their end."""

    task_id: str
    dynamics: str

    @pytest.fixture(autouse=True)
    def _checkpoint(self, tmp_path, generator) -> None:
        """Random weights."""
        if self.dynamics == "learned":
            model = random_model(make_task(self.task_id).scene, generator)
            self.dynamics = save_checkpoint(model, tmp_path, make_card(model))

    def make_object_under_test(self) -> DmEnvironment:
        task = make_task(self.task_id)
        task.horizon = HORIZON
        return DmEnvironment(task, self.dynamics)


for _number, _task in enumerate(TASKS):
    for _dynamics in ("mujoco", "learned"):
        _name = f"Test_{_task.replace('/', '_')}_{_dynamics}"
        _is_quick = (_dynamics == "learned") == bool(_number % 2)  # each task once
        _marks = [] if _is_quick else [pytest.mark.slow]
        _fields = {"task_id": _task, "dynamics": _dynamics, "pytestmark": _marks}
        globals()[_name] = type(_name, (Contract, absltest.TestCase), _fields)


def test_steps_are_those_of_the_env(task_id, seed, rng):
    env = DmEnvironment(task_id, "mujoco", seed)
    bare = make_env(task_id, dynamics="mujoco", seed=seed)
    step = env.reset()
    np.testing.assert_array_equal(step.observation, bare.reset()["observation"][0])
    for _ in range(4):
        action = rng.uniform(-1.0, 1.0, env.action_spec().shape).astype(np.float32)
        step, after = env.step(action), act(bare, torch.from_numpy(action)[None])
        np.testing.assert_array_equal(step.observation, after["observation"][0])
        assert step.reward == float(after["reward"])
        assert step.last() == bool(after["done"])
        assert step.discount == 1.0 - float(after["terminated"])
        if step.last():
            break


def test_failure_has_no_discount_and_the_end_of_time_has(seed):
    task = make_task("cartpole/swingup")
    task.horizon = 3
    env = DmEnvironment(task, "mujoco", seed)
    env.reset()
    steps = [env.step(np.zeros(1)) for _ in range(3)]
    assert [step.last() for step in steps] == [False, False, True]
    assert [step.discount for step in steps] == [1.0, 1.0, 1.0]
    assert env.step(np.zeros(1)).step_type is dm_env.StepType.FIRST
    state = env.env.state
    state["qpos"][0, 0] = 4.2  # m, off the rail
    env.env.reset(state, set_state=True)
    step = env.step(np.zeros(1))
    assert step.last() and step.discount == 0.0


def test_a_suite_task_is_what_the_suite_itself_gives(seed, rng):
    env = DmEnvironment("dm_control/acrobot-swingup", "dm_control", seed)
    theirs = suite.load(
        "acrobot", "swingup", environment_kwargs={"flat_observation": 1}
    )
    start = env.reset()
    theirs.reset()
    state = env.env.state[0]
    with theirs.physics.reset_context():
        theirs.physics.data.qpos[:], theirs.physics.data.qvel[:] = (
            state["qpos"],
            state["qvel"],
        )
    assert start.reward is None and start.discount is None
    for _ in range(20):
        action = rng.uniform(-1.0, 1.0, 1).astype(np.float32)
        got, expected = env.step(action), theirs.step(action)
        flat = expected.observation["observations"]
        np.testing.assert_allclose(got.observation, flat, rtol=1e-6, atol=1e-6)
        assert got.reward == pytest.approx(expected.reward, abs=1e-6)
        assert got.step_type is expected.step_type
        assert got.discount == expected.discount
