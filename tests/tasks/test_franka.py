"""Reach against its formulas; actions that are held over several control steps."""

import mujoco
import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_nerd import GroundTruthEnv
from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.robots import make_task

BOXED = ("franka/reach", "franka/reach_torque", "franka_gravity/reach_torque")
REACH = (*BOXED, "franka/reach_osc")
LOW = (-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973)  # rad; data sheet
HIGH = (2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973)
HOME = (0.0, -0.7853, 0.0, -2.3575, 0.0, 1.5703, 0.7857)  # rad
KP = np.array([600.0] * 4 + [250.0, 150.0, 50.0])
KD = np.array([5.0] * 4 + [3.0, 2.5, 1.5])
LIMIT = np.array([87.0] * 4 + [12.0] * 3)


def random_state(task, generator, rows=64):
    size = rows, task.num_uniforms
    u = torch.rand(size, generator=generator, dtype=torch.float64)
    state = TensorDict(task.initial_state(u), [rows])
    noise = torch.randn(2, rows, 7, generator=generator, dtype=torch.float64)
    return state.update({"qpos": 4.0 * noise[0], "qvel": noise[1]})


def hand(task, qpos):
    """Where MuJoCo has the point 0.21207 m along the last link."""
    model, places = task.scene.model, []
    data = mujoco.MjData(model)
    for row in qpos.numpy():
        data.qpos = row
        mujoco.mj_kinematics(model, data)
        link = data.body("link7")
        places.append(link.xpos + 0.21207 * link.xmat.reshape(3, 3)[:, 2])
    return np.array(places)


@pytest.mark.parametrize("task_id", REACH)
def test_reach_rewards_observations_and_no_end(task_id, generator):
    task = make_task(task_id)
    before, state = (random_state(task, generator) for _ in range(2))
    state["goal"][::2] = task.end_effector(state["qpos"])[::2] + 0.01  # near ones too
    place = hand(task, state["qpos"])
    d = np.linalg.norm(place - state["goal"].numpy(), axis=-1)
    want = -d + sum(1.0 / (np.exp(k * d) + np.exp(-k * d) + 1e-4) for k in (50, 300))
    np.testing.assert_allclose(
        task.reward(before, torch.zeros(64, 1), state), want, rtol=1e-9
    )
    qpos = state["qpos"].numpy()
    angle = np.arctan2(np.sin(qpos), np.cos(qpos))
    goal = state["goal"].numpy() - place * (task_id == "franka/reach_osc")
    seen = np.concatenate((angle, place, goal), -1)
    np.testing.assert_allclose(task.observation(state), seen, atol=1e-9)
    horizon = 64 if task_id == "franka/reach_osc" else 128
    assert not task.terminated(state).any() and task.horizon == horizon


@pytest.mark.parametrize("task_id", BOXED)
def test_reach_resets_fill_their_ranges(task_id, generator):
    task = make_task(task_id)
    u = torch.rand(4096, task.num_uniforms, generator=generator, dtype=torch.float64)
    start = task.initial_state(u)
    offset = (start["qpos"] - torch.tensor(HOME, dtype=torch.float64)) / 0.125
    assert (offset.abs() <= 1.0 + 1e-12).all() and (offset.abs().amax(0) > 0.97).all()
    assert not start["qvel"].any()
    low, high = torch.tensor(((0.3, -0.35, 0.05), (0.7, 0.35, 0.45))).double()
    share = (start["goal"] - low) / (high - low)
    assert (share.amin(0) > -1e-6).all() and (share.amax(0) < 1.0 + 1e-6).all()
    assert (share.amin(0) < 0.02).all() and (share.amax(0) > 0.98).all()


def test_a_goal_is_kept_until_its_row_is_reset():
    env = GroundTruthEnv("franka/reach_torque", num_envs=3)
    first = env.reset()
    after = env.rand_step(first)["next"]
    assert torch.equal(after["goal"], first["goal"])
    rows = torch.tensor([[True], [False], [True]])
    again = env.reset(after.clone().set("_reset", rows))
    is_kept = (again["goal"] == first["goal"]).all(-1)
    assert is_kept.tolist() == [False, True, False]
    wanted = torch.rand(3, 3, dtype=torch.float64)
    given = env.reset(first.clone().set("goal", wanted), set_state=True)
    assert torch.equal(given["goal"], wanted)


def test_a_held_action_takes_its_target_anew_at_each_control_step(generator):
    env = GroundTruthEnv("franka/reach", num_envs=4)
    state = env.reset()
    action = 2.0 * torch.rand(4, 7, generator=generator) - 1.0
    got = env.step(state.clone().set("action", action))["next"]
    dynamics, torque = MujocoDynamics(env.scene, num_threads=1), None
    moved = state.select("qpos", "qvel")
    dynamics.reset(moved)
    for _ in range(2):
        qvel = moved["qvel"].numpy()
        pull = (
            KP * 0.03125 * action.double().numpy() - KD * qvel
        )  # target = q + scale a
        torque = torch.from_numpy(pull.clip(-LIMIT, LIMIT))
        moved = dynamics.step(moved, torque)
    for key in ("qpos", "qvel"):
        torch.testing.assert_close(got[key], moved[key], rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(got["joint_torque"], torque, rtol=1e-9, atol=1e-9)


def test_goals_of_the_operational_space_task_are_hands_of_the_arm(generator):
    task = make_task("franka/reach_osc")
    u = torch.rand(512, task.num_uniforms, generator=generator, dtype=torch.float64)
    start = task.initial_state(u)
    pose = u.new_tensor(HOME) + 2.0 * 0.5 * (u[:, 7:] - 0.5)
    assert (pose > u.new_tensor(LOW)).all() and (pose < u.new_tensor(HIGH)).all()
    np.testing.assert_allclose(start["goal"], hand(task, pose), atol=1e-10)
    assert (start["goal"][:, 2] > 0.14).all()  # m, over the table
    boxed = make_task("franka/reach").initial_state(u[:, :10])
    assert torch.equal(start["qpos"], boxed["qpos"]) and not start["qvel"].any()


def test_the_hand_goes_where_the_action_points(seed):
    """Straight to the goal, in the ground truth, by a proportional policy."""
    env = GroundTruthEnv("franka/reach_osc", num_envs=8, seed=seed)
    now = env.reset()
    toward = now["observation"][:, 10:]
    for _ in range(env.task.horizon - 1):
        action = (10.0 * now["observation"][:, 10:]).clamp(-1.0, 1.0)
        now = env.step(now.set("action", action))["next"]
    way = torch.linalg.vector_norm(toward, dim=-1)
    left = torch.linalg.vector_norm(now["observation"][:, 10:], dim=-1)
    assert (left < 1e-3).all() and (way > 1e-2).any() and not now["fault"].any()
