"""Tasks of Ant and ANYmal against their formulas, written again with matrices."""

import numpy as np
import pytest
import torch
from helpers import random_quats, yaw_quat
from tensordict import TensorDict

from torchrl_nerd.geometry.rotations import quat_multiply, rotate
from torchrl_nerd.robots import make_task
from torchrl_nerd.robots.ant.scene import STANDING_POSE as ANT_POSE
from torchrl_nerd.robots.anymal.scene import STANDING_POSE as ANYMAL_POSE

ROWS = 64
ANT = ("ant/run", "ant/spin", "ant/spin_track")
ANYMAL = ("anymal/forward", "anymal/sideways")


def random_state(task, generator, rows=ROWS):
    """Any orientation, any joints, moderate speeds."""
    model = task.scene.model
    qpos = torch.randn(rows, model.nq, generator=generator, dtype=torch.float64)
    qpos[:, 3:7] = random_quats(rows, generator)
    qvel = torch.randn(rows, model.nv, generator=generator, dtype=torch.float64)
    return TensorDict({"qpos": qpos, "qvel": qvel}, [rows])


def uniforms(task, generator, rows=4096):
    shape = (rows, task.num_uniforms)
    return torch.rand(shape, generator=generator, dtype=torch.float64)


def matrices(state):
    """Rotation matrices of the base, column by column."""
    quat = state["qpos"][:, 3:7]
    axes = torch.eye(3, dtype=torch.float64)
    columns = [rotate(quat, axis.expand(len(quat), 3)) for axis in axes]
    return torch.stack(columns, -1).numpy()


def seen(state):
    """Quantities that rewards are made of: v, w (world), p_up, p_heading."""
    turn, qvel = matrices(state), state["qvel"].numpy()
    spin = np.einsum("nij,nj->ni", turn, qvel[:, 3:6])
    return qvel[:, :3], spin, turn[:, 2, 2], turn[:, 0, 0]


@pytest.mark.parametrize("task_id", ANT + ANYMAL)
def test_observation_is_the_papers_list(task_id, generator):
    task = make_task(task_id)
    state = random_state(task, generator)
    v, w, up, heading = seen(state)
    qpos, qvel = state["qpos"].numpy(), state["qvel"].numpy()
    parts = [qpos[:, 2:7], v, w, qpos[:, 7:], qvel[:, 6:], up[:, None]]
    want = np.concatenate([*parts, heading[:, None]], -1)
    got = task.observation(state)
    assert got.shape[-1] == {"ant": 29, "anymal": 37}[task.scene.name]
    np.testing.assert_allclose(got, want, atol=1e-12)


@pytest.mark.parametrize("task_id", ANT + ANYMAL)
def test_rewards_are_the_papers(task_id, generator):
    task = make_task(task_id)
    before, after = (random_state(task, generator) for _ in range(2))
    width = task.controller.num_actions
    action = 2.0 * torch.randn(ROWS, width, generator=generator, dtype=torch.float64)
    v, w, up, heading = seen(after)
    q, rate = before["qpos"][:, 7:].numpy(), before["qvel"][:, 6:].numpy()
    if task_id == "ant/run":
        want = v[:, 0] + 0.1 * up + heading
    elif task_id == "ant/spin":
        want = w[:, 2] + up
    elif task_id == "ant/spin_track":
        cost = (w[:, 2] - 5.0) ** 2 + 0.1 * w[:, 0] ** 2 + 0.1 * w[:, 1] ** 2
        want = 5.0 * np.exp(-cost) + 0.1 * up
    else:
        target = ANYMAL_POSE + 0.5 * action.numpy().clip(-1.0, 1.0)
        torque = (85.0 * (target - q) - 2.0 * rate).sum(-1)
        wanted = {"anymal/forward": (1.0, 0.0), "anymal/sideways": (0.0, -1.0)}
        offset = v[:, :2] - wanted[task_id]
        want = np.exp(-(offset**2).sum(-1)) + 0.5 * np.exp(-(w[:, 2] ** 2))
        want = want - (0.002 * torque) ** 2
    np.testing.assert_allclose(task.reward(before, action, after), want, atol=1e-12)


@pytest.mark.parametrize("task_id", ANT + ANYMAL)
def test_place_and_turns_about_the_vertical_change_only_what_they_should(
    task_id, generator
):
    task = make_task(task_id)
    state = random_state(task, generator)
    yaw, shift = torch.rand(2, generator=generator).tolist()
    moved, quat = state.clone(), yaw_quat(6.0 * yaw).double()
    moved["qpos"][:, :2] += 1e3 * shift
    torch.testing.assert_close(task.observation(moved), task.observation(state))
    assert torch.equal(task.terminated(moved), task.terminated(state))
    spun = quat.expand(ROWS, 4)
    moved["qpos"][:, 3:7] = quat_multiply(spun, state["qpos"][:, 3:7])
    moved["qvel"][:, :3] = rotate(spun, state["qvel"][:, :3])
    seen_before, seen_after = task.observation(state), task.observation(moved)
    kept = [0, 7, 10, *range(11, seen_before.shape[1] - 1)]  # no heading
    torch.testing.assert_close(seen_after[:, kept], seen_before[:, kept])
    for part in (slice(5, 8), slice(8, 11)):
        turned = rotate(spun, seen_before[:, part])
        torch.testing.assert_close(seen_after[:, part], turned)
    if "spin" in task_id:
        action = torch.zeros(ROWS, 8)
        rewards = (task.reward(state, action, after) for after in (state, moved))
        torch.testing.assert_close(*rewards)


def test_ant_starts_within_its_ranges_and_fills_them(generator):
    task = make_task("ant/run")
    start = task.initial_state(uniforms(task, generator))
    center = torch.tensor([0.0, 0.0, 1.0, *ANT_POSE], dtype=torch.float64)
    half = torch.tensor([0.2, 0.2, 0.1, *[0.2] * 8], dtype=torch.float64)
    where = torch.cat((start["qpos"][:, :3], start["qpos"][:, 7:]), -1)
    reach = ((where - center) / half).abs().amax(0)
    assert (reach <= 1.0 + 1e-12).all() and (reach > 0.97).all()
    angle = 2.0 * start["qpos"][:, 3].abs().clamp_max(1.0).acos()
    assert 0.95 * np.pi / 6 < angle.max() <= np.pi / 6 + 1e-9
    local = np.einsum("nji,nj->ni", matrices(start), start["qvel"][:, :3].numpy())
    assert 0.097 < abs(local).max() <= 0.1 + 1e-12
    rates = start["qvel"][:, 3:].abs().amax(0)
    assert (rates <= 0.25).all() and (rates > 0.24).all()


def test_anymal_starts_within_its_ranges_and_fills_them(generator):
    task = make_task("anymal/forward")
    start = task.initial_state(uniforms(task, generator))
    base = torch.tensor([0.0, 0.0, 0.7, 1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    assert torch.equal(start["qpos"][:, :7], base.expand(4096, 7))
    assert not start["qvel"][:, :6].any()
    factor = start["qpos"][:, 7:] / torch.tensor(ANYMAL_POSE, dtype=torch.float64)
    assert (factor.amin(0) >= 0.5).all() and (factor.amax(0) <= 1.5).all()
    assert (factor.amin(0) < 0.52).all() and (factor.amax(0) > 1.48).all()
    rates = start["qvel"][:, 6:].abs().amax(0)
    assert (rates <= 0.1).all() and (rates > 0.097).all()


@pytest.mark.parametrize(
    ("task_id", "limit"), [("ant/run", 0.3), ("anymal/forward", 0.4)]
)
def test_an_episode_ends_below_its_height_and_not_on_it(task_id, limit):
    task = make_task(task_id)
    u = torch.full((2, task.num_uniforms), 0.5, dtype=torch.float64)
    state = task.initial_state(u)
    assert not task.terminated(state).any()
    state["qpos"][:, 2] = torch.tensor([limit, np.nextafter(limit, 0.0)])
    if task_id == "anymal/forward":  # legs up: nothing else is near the ground
        state["qpos"][:, 7:] = 0.0
        state["qpos"][:, 8::3] = torch.tensor([1.0, 1.0, -1.0, -1.0]) * 1.5
    assert task.terminated(state).tolist() == [False, True]


def test_anymal_ends_where_base_or_knees_touch_but_not_feet(generator):
    task = make_task("anymal/forward")
    scene = task.scene
    state = random_state(task, generator, 2000)
    state["qpos"][:, 2] = 0.6 + 0.2 * state["qpos"][:, 2].abs()
    names = [scene.model.body(body).name for body in scene.contacts.bodies]
    clearance = scene.clearances(state["qpos"]).numpy()
    is_foot = np.array([name.endswith("SHANK") for name in names])
    assert is_foot.sum() == 4 and len(names) == 14
    want = clearance[:, ~is_foot].min(-1) < 0.01
    np.testing.assert_array_equal(task.terminated(state), want)
    only_feet = (clearance[:, is_foot].min(-1) < 0.0) & ~want
    assert want.any() and only_feet.any()
