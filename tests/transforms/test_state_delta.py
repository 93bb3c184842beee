"""The change of state: integrates back exactly, and is blind to place and heading."""

import pytest
import torch
from helpers import (
    HANDMADE,
    every_scene,
    moved_rows,
    moved_scene,
    mujoco_step,
    random_states,
    random_transitions,
)
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import TransformedEnv

from torchrl_nerd.envs import GroundTruthEnv
from torchrl_nerd.geometry.manifold import differentiate_pos, integrate_pos
from torchrl_nerd.keys import NEXT_QPOS, NEXT_QVEL, QPOS, QVEL, STATE_DELTA
from torchrl_nerd.transforms import StateDelta

ROWS = 100


def delta_of(scene, rows):
    keys = (QPOS, QVEL, NEXT_QPOS, NEXT_QVEL)
    return StateDelta(scene).delta(*(rows[key] for key in keys))


@every_scene
def test_integrating_returns_the_next_state(scene, generator):
    rows, transform = random_transitions(scene, ROWS, generator), StateDelta(scene)
    delta = delta_of(scene, rows)
    assert delta.shape == (ROWS, transform.size) == (ROWS, 2 * scene.model.nv)
    qpos, qvel = transform.integrate(rows[QPOS], rows[QVEL], delta)
    error = differentiate_pos(scene.layout, rows[NEXT_QPOS], qpos)
    assert error.abs().max() < 1e-12
    torch.testing.assert_close(qvel, rows[NEXT_QVEL], rtol=1e-14, atol=1e-12)


@every_scene
def test_errors_of_positions_weigh_as_speeds(scene, generator):
    """As far as one moves the robot in a control step, and never more than a velocity."""
    rows, transform = random_transitions(scene, ROWS, generator), StateDelta(scene)
    nv, step = scene.model.nv, scene.control_step
    speed, distance = 1e-3 * torch.rand(2, generator=generator).double() + 1e-5
    std = torch.cat((speed.expand(nv), (step * distance).expand(nv)))
    error = torch.randn(ROWS, 2 * nv, generator=generator).double()
    error[:, :nv] = 0.0
    states, delta = (rows[QPOS], rows[QVEL]), delta_of(scene, rows)
    ends = (transform.integrate(*states, x)[0] for x in (delta, delta + std * error))
    moved = differentiate_pos(scene.layout, *ends)
    expected = moved.norm(dim=-1) / (step * speed)
    weights = transform.error_weights(std)
    bound = min(1.0, float(speed / distance))  # where a position would weigh more
    found = (weights * error).norm(dim=-1) / bound
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=0.0)
    assert weights.max() == 1.0


@every_scene
def test_any_two_states_are_a_change_apart(scene, rng):
    """Even far from each other: turns of up to half a circle."""
    transform = StateDelta(scene)
    start, end = (random_states(scene.model, ROWS, rng) for _ in range(2))
    qpos, qvel = transform.integrate(*start, transform.delta(*start, *end))
    error = differentiate_pos(scene.layout, end[0], qpos)
    assert error.abs().max() < 1e-12
    torch.testing.assert_close(qvel, end[1], rtol=0.0, atol=1e-12)


@every_scene
def test_any_change_leads_to_a_state_and_back(scene, rng):
    transform, size = StateDelta(scene), 2 * scene.model.nv
    start = random_states(scene.model, ROWS, rng)
    change = torch.from_numpy(0.3 * rng.normal(size=(ROWS, size)))
    end = transform.integrate(*start, change)
    for q, _ in scene.layout.rotations:
        length = torch.linalg.vector_norm(end[0][:, q : q + 4], dim=-1)
        torch.testing.assert_close(length, torch.ones_like(length))
    back = transform.delta(*start, *end)
    torch.testing.assert_close(back, change, rtol=0.0, atol=1e-12)


@every_scene
@pytest.mark.parametrize(("distance", "tolerance"), [(1.0, 1e-10), (1e6, 1e-8)])
def test_place_and_heading_are_not_in_it(scene, distance, tolerance, generator):
    rows = random_transitions(scene, ROWS, generator)
    yaw, *shift = torch.randn(4, dtype=torch.float64, generator=generator)
    where = float(yaw), distance * torch.stack(shift)
    elsewhere, moved = moved_scene(scene, *where), moved_rows(scene, rows, *where)
    got, want = delta_of(elsewhere, moved), delta_of(scene, rows)
    torch.testing.assert_close(got, want, rtol=1e-12, atol=tolerance)


@every_scene
def test_a_robot_moves_the_same_way_everywhere(scene, generator):
    """What makes a frame of its own lossless: MuJoCo itself agrees."""
    rows = random_transitions(scene, ROWS, generator)
    yaw, *shift = torch.randn(4, dtype=torch.float64, generator=generator)
    shift = torch.stack(shift)
    moved = moved_rows(scene, rows.exclude("next"), float(yaw), shift)
    elsewhere = moved_scene(scene, float(yaw), shift)
    there = mujoco_step(elsewhere, moved, rows["next", "joint_torque"])
    got, want = delta_of(elsewhere, there), delta_of(scene, rows)
    assert (got - want).abs().max() < 1e-5 * want.abs().max()


@every_scene
def test_steady_motion_is_zero(scene, rng):
    """A velocity that stays the same in the moving axes leaves nothing to predict."""
    start = random_states(scene.model, ROWS, rng)
    after = integrate_pos(scene.layout, start[0], scene.control_step * start[1])
    delta = StateDelta(scene).delta(*start, after, start[1])
    assert delta.abs().max() < 1e-13


def test_a_thrown_robot_falls(rng):
    """Constant acceleration: the trapezoid rule is exact, so only velocity changes."""
    scene, g = HANDMADE["floater"], torch.tensor([0.0, 0.0, -9.81]).double()
    qpos, qvel = random_states(scene.model, ROWS, rng)
    qvel[:, 3:] = 0.0
    h, after, next_qpos = scene.control_step, qvel.clone(), qpos.clone()
    after[:, :3] += h * g
    next_qpos[:, :3] += h * qvel[:, :3] + 0.5 * h**2 * g
    change, residual = (
        StateDelta(scene).delta(qpos, qvel, next_qpos, after).chunk(2, -1)
    )
    size = torch.linalg.vector_norm(change[:, :3], dim=-1)
    torch.testing.assert_close(size, torch.full_like(size, 9.81 * h))
    assert residual.abs().max() < 1e-14 and change[:, 3:].abs().max() < 1e-14


@every_scene
def test_forward_and_inverse_on_tensordicts(scene, generator):
    rows, transform = random_transitions(scene, 6, generator), StateDelta(scene)
    out = transform(rows.clone().reshape(2, 3)).reshape(6)
    assert out[STATE_DELTA].dtype == torch.float64
    assert (out.select(*rows.keys(True, True)) == rows).all()
    start = out.select(QPOS, QVEL, STATE_DELTA)
    back = transform.inv(start.clone())
    qpos, qvel = transform.integrate(start[QPOS], start[QVEL], start[STATE_DELTA])
    assert torch.equal(back[NEXT_QPOS], qpos) and torch.equal(back[NEXT_QVEL], qvel)


def test_missing_states_are_named(scene, generator):
    rows, transform = random_transitions(scene, 2, generator), StateDelta(scene)
    with pytest.raises(KeyError, match="StateDelta needs .*next.*qpos.*got"):
        transform(rows.exclude("next"))
    with pytest.raises(KeyError, match="inverse of StateDelta needs .*qvel"):
        transform.inv(transform(rows.clone()).exclude(QVEL))


def test_storing_what_an_env_recorded_changes_nothing(task_id, generator):
    """A root's ``state_delta`` is that of the step before: the inverse must not use it."""
    scene = GroundTruthEnv(task_id).scene
    env = TransformedEnv(GroundTruthEnv(task_id, num_envs=3), StateDelta(scene))
    recorded = env.rollout(5, break_when_any_done=False).reshape(-1)
    buffer = ReplayBuffer(
        storage=LazyTensorStorage(20), transform=StateDelta(scene), batch_size=4
    )
    buffer.extend(recorded.clone())
    stored: TensorDict = buffer._storage[:].clone()
    for key in (QPOS, QVEL, NEXT_QPOS, NEXT_QVEL):
        assert torch.equal(stored[key], recorded[key])
