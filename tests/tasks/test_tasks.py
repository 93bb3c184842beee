"""Tasks against their formulas (NeRD, appendix B and C), written again in NumPy."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from dynamics_helpers import random_drive
from tensordict import TensorDict

from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.robots import TASKS, load_scene, make_task

ROWS = 64
ALMOST_ONE = 1.0 - 2.0**-53
PI = np.pi


def random_state(task, generator, rows: int = ROWS) -> TensorDict:
    """States of the scene's training ranges, with the task's own parameters."""
    state, _, _ = random_drive(task.scene, rows, 1, generator)
    drawn = task.initial_state(uniforms(task, generator, rows))
    return state.update({key: drawn[key] for key in task.parameters})


def uniforms(task, generator, *rows: int) -> torch.Tensor:
    shape = (*(rows or (ROWS,)), task.num_uniforms)
    return torch.rand(shape, generator=generator, dtype=torch.float64)


def wrapped(angle: np.ndarray) -> np.ndarray:
    return np.arctan2(np.sin(angle), np.cos(angle))


def numbers(state: TensorDict) -> list[np.ndarray]:
    """Every coordinate, then every velocity, each ``(rows,)``."""
    return [*state["qpos"].numpy().T, *state["qvel"].numpy().T]


def test_every_task_keeps_its_promises(task_id, generator):
    task = make_task(task_id)
    state, after = (random_state(task, generator) for _ in range(2))
    width = task.controller.num_actions
    action = 2.0 * torch.rand(ROWS, width, generator=generator) - 1.0
    before = state.clone(), after.clone()
    observation, reward = task.observation(state), task.reward(state, action, after)
    terminated = task.terminated(after)
    assert observation.shape == (ROWS, task.observation_size)
    assert reward.shape == terminated.shape == (ROWS,)
    assert observation.dtype == reward.dtype == torch.float64
    assert terminated.dtype == torch.bool
    assert observation.isfinite().all() and reward.isfinite().all()
    assert task.horizon > 0
    for kept, now in zip(before, (state, after), strict=True):
        assert all(torch.equal(kept[key], now[key]) for key in kept.keys())


def test_leading_dimensions_are_free(task_id, generator):
    task = make_task(task_id)
    state = random_state(task, generator, 12)
    action = torch.zeros(12, task.controller.num_actions)
    shaped, split = state.reshape(3, 4), action.reshape(3, 4, -1)
    for flat, deep in (
        (task.observation(state), task.observation(shaped)),
        (task.reward(state, action, state), task.reward(shaped, split, shaped)),
        (task.terminated(state), task.terminated(shaped)),
    ):
        assert torch.equal(deep.flatten(0, 1), flat)
    u = uniforms(task, generator, 3, 4)
    flat, deep = task.initial_state(u.flatten(0, 1)), task.initial_state(u)
    assert all(torch.equal(deep[key].flatten(0, 1), flat[key]) for key in flat)


def test_resets_are_sound_states_at_which_no_episode_ends(task_id, generator):
    task = make_task(task_id)
    model, u = task.scene.model, uniforms(task, generator, 4096)
    edges = torch.randint(2, (4096, task.num_uniforms), generator=generator)
    for draw in (u, edges.double() * ALMOST_ONE):
        start = task.initial_state(draw)
        sizes = {"qpos": model.nq, "qvel": model.nv, **task.parameters}
        assert {key: value.shape[-1] for key, value in start.items()} == sizes
        assert all(value.dtype == torch.float64 for value in start.values())
        assert all(value.isfinite().all() for value in start.values())
        assert not task.terminated(start).any()
        assert torch.equal(task.initial_state(draw.clone())["qpos"], start["qpos"])
    assert len(task.initial_state(u)["qpos"].unique(dim=0)) == 4096


def test_cartpole_resets_fill_their_ranges(generator):
    task = make_task("cartpole/swingup")
    half = np.array([1.0, PI, 1.0, 1.0])  # m, rad, m/s, rad/s
    u = uniforms(task, generator, 4096)
    start = task.initial_state(u)
    state = torch.cat((start["qpos"], start["qvel"]), -1).numpy()
    np.testing.assert_allclose(state, (2.0 * u.numpy() - 1.0) * half, atol=1e-15)


def test_cartpole_reward_observation_and_end(generator):
    task = make_task("cartpole/swingup")
    before, state = (random_state(task, generator) for _ in range(2))
    for each in (before, state):
        each["qpos"] *= 3.0  # several turns, and off the rail
        each["qvel"] *= 1.5
    x, theta, speed, spin = numbers(state)
    angle = wrapped(theta)
    reward = 5.0 - angle**2 - 0.05 * x**2 - 0.1 * spin**2 - 0.1 * speed**2
    end = (abs(x) > 4.0) | (abs(speed) > 10.0) | (abs(spin) > 10.0)
    got = task.reward(before, torch.zeros(ROWS, 1), state)
    np.testing.assert_allclose(got, reward, atol=1e-12)
    observed = np.stack((x, angle, speed, spin), -1)
    np.testing.assert_allclose(task.observation(state), observed, atol=1e-12)
    np.testing.assert_array_equal(task.terminated(state), end)
    assert 0 < end.sum() < ROWS


@pytest.mark.parametrize(("index", "limit"), [(0, 4.0), (2, 10.0), (3, 10.0)])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_cartpole_ends_beyond_its_limits_and_not_on_them(index, limit, sign):
    task = make_task("cartpole/swingup")
    numbers = torch.zeros(2, 4, dtype=torch.float64)
    numbers[0, index] = sign * limit
    numbers[1, index] = sign * np.nextafter(limit, 100.0)
    state = {"qpos": numbers[:, :2], "qvel": numbers[:, 2:]}
    assert task.terminated(state).tolist() == [False, True]


GROUNDS = (  # offset (m) and Euler angles in the paper's axes, y up; facts of its code
    (-15.5, (0.0, 0.0, 0.0)),
    (0.0, (0.0, 0.0, 0.0)),
    (0.2, (PI / 8, PI / 16, PI / 16)),
    (0.5, (0.0, 0.0, 0.0)),
    (-0.5, (0.0, 0.0, 0.0)),
    (-0.3, (0.0, 0.0, 0.0)),
    (0.0, (PI / 8, 0.0, 0.0)),
)


def plane(offset: float, euler: tuple[float, float, float]) -> np.ndarray:
    """Normal and offset in our axes: the paper's up axis turned, then y up to z up."""
    (ca, cb, cc), (sa, sb, sc) = np.cos(euler), np.sin(euler)
    about_x = np.array([[1, 0, 0], [0, ca, -sa], [0, sa, ca]])
    about_y = np.array([[cb, 0, sb], [0, 1, 0], [-sb, 0, cb]])
    about_z = np.array([[cc, -sc, 0], [sc, cc, 0], [0, 0, 1]])
    y_up = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    turn = y_up @ about_z @ about_y @ about_x
    normal = turn @ [0.0, 1.0, 0.0]
    return np.append(normal, normal @ y_up @ [0.0, offset, 0.0])


def test_pendulum_resets(generator):
    task = make_task("double_pendulum/passive")
    u = uniforms(task, generator, 4096)
    start = task.initial_state(u)
    first, second, *speed = numbers(start)
    assert (abs(first) <= PI).all() and (abs(second) <= PI).all()
    np.testing.assert_allclose(first, PI * (2.0 * u[:, 0] - 1.0), atol=1e-14)
    upward = wrapped(
        first + second
    )  # the second link's own angle, uniform over [0, pi)
    np.testing.assert_allclose(upward, PI * u[:, 1], atol=1e-13)
    np.testing.assert_allclose(np.stack(speed, -1), 4.0 * u[:, 2:4] - 2.0, atol=1e-14)
    planes = np.array([plane(*ground) for ground in GROUNDS])
    distance = abs(start["terrain"].numpy()[:, None] - planes).max(-1)
    np.testing.assert_allclose(distance.min(-1), 0.0, atol=1e-14)
    assert (np.bincount(distance.argmin(-1), minlength=7) > 4096 / 7 * 0.7).all()


@pytest.mark.parametrize("number", range(len(GROUNDS)))
def test_pendulum_over_one_named_ground(number, generator):
    task = TASKS["double_pendulum/passive"](ground=number)
    start = task.initial_state(uniforms(task, generator))
    expected = np.tile(plane(*GROUNDS[number]), (ROWS, 1))
    np.testing.assert_allclose(start["terrain"], expected, atol=1e-14)


def test_pendulum_observation_reward_and_end(generator):
    task = make_task("double_pendulum/passive")
    before, state = (random_state(task, generator) for _ in range(2))
    first, second, *speed = numbers(state)
    observed = [np.sin(first), np.sin(second), np.cos(first), np.cos(second), *speed]
    np.testing.assert_allclose(
        task.observation(state), np.stack(observed, -1), atol=1e-15
    )
    assert not task.reward(before, torch.zeros(ROWS, 2), state).any()
    assert not task.terminated(state).any()


@pytest.mark.parametrize("other", ["anymal", "double_pendulum", "cartpole"])
def test_a_scene_of_another_robot_is_refused(other):
    for task in (
        make_task("ant/run"),
        make_task("cube/toss"),
        make_task("cartpole/swingup"),
    ):
        scene = load_scene(other)
        if task.scene.name == other:
            finer = task.with_scene(scene.with_substeps(3))
            assert finer.scene.substeps == 3 and type(finer) is type(task)
        else:
            said = f"the robot of '{task.scene.name}', got another robot in '{other}'"
            with pytest.raises(ValueError, match=said):
                task.with_scene(scene)


@pytest.mark.parametrize("name", ["franka/reach_osc", "gymnasium/Humanoid-v5"])
def test_another_scene_of_the_robot_is_seen_whatever_was_read_before(name, generator):
    """As a task that was never asked for anything sees it."""
    model = copy.copy(make_task(name).scene.model)
    model.body_mass *= np.linspace(1.0, 3.0, model.nbody)
    heavy = replace(make_task(name).scene, model=model)
    read, fresh = make_task(name), make_task(name).with_scene(heavy)
    state = random_state(read, generator)
    action = torch.zeros(ROWS, read.controller.num_actions)
    read.reward(state, action, state), read.observation(state)
    again = read.with_scene(heavy)
    for task in (again, fresh):
        assert task.scene is heavy
    torques = [
        task.controller(action.double(), state[QPOS], state[QVEL])
        for task in (again, fresh)
    ]
    assert torch.equal(*torques)
    rewards = [task.reward(state, action, state) for task in (again, fresh)]
    assert torch.equal(*rewards)


def test_unknown_tasks_and_grounds_are_refused_in_one_sentence():
    with pytest.raises(ValueError) as caught:
        make_task("cartpole/juggle")
    assert "cartpole/juggle" in str(caught.value)
    assert all(task_id in str(caught.value) for task_id in TASKS)
    for number in (-1, 7):
        with pytest.raises(ValueError, match=f"ground from 0 to 6, got {number}"):
            TASKS["double_pendulum/passive"](ground=number)
