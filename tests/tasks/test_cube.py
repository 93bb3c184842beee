"""Tosses: starts in their ranges and clear of the ground, nothing to act on."""

import pytest
import torch
from dynamics_helpers import act

from torchrl_nerd import GroundTruthEnv
from torchrl_nerd.robots import make_task

TOSSES = ("cube/toss", "cube_real/toss")


@pytest.mark.parametrize("task_id", TOSSES)
def test_tosses_start_in_their_ranges_and_clear_of_the_ground(task_id, generator):
    task = make_task(task_id)
    u = torch.rand(4096, task.num_uniforms, generator=generator, dtype=torch.float64)
    start = task.initial_state(u)
    low, high = torch.tensor(((-1.048, -1.048, 0.0472), (1.048, 1.048, 0.262))).double()
    place = start["qpos"][:, :3]
    assert (place > low - 1e-6).all() and (place < high + 1e-6).all()
    assert place[:, 2].max() > 0.255
    clearance = task.scene.clearances(start["qpos"]).amin(-1)
    assert 1e-3 - 1e-9 < clearance.min() < 2e-3
    angle = 2.0 * start["qpos"][:, 3].abs().clamp_max(1.0).acos()
    assert 0.95 * torch.pi / 6 < angle.max() <= torch.pi / 6 + 1e-9
    spin = start["qvel"][:, 3:]
    low, high = torch.tensor(((-10.0, -10.0, -7.0), (12.0, 8.0, 4.0))).double()
    share = (spin - low) / (high - low)
    assert (share.amin(0) < 0.02).all() and (share.amax(0) > 0.98).all()
    speed = torch.linalg.vector_norm(start["qvel"][:, :3], dim=-1)
    assert speed.max() <= (2 * 3.5**2 + 1.0) ** 0.5 + 1e-9


@pytest.mark.parametrize("task_id", TOSSES)
def test_a_toss_needs_no_action_and_comes_down(task_id):
    env = GroundTruthEnv(task_id, num_envs=8)
    assert env.action_spec.shape == (8, 0)
    start = env.reset()
    after = act(env, torch.zeros(8, 0))
    assert after["joint_torque"].shape == (8, 0)
    fall = after["qvel"][:, 2] - start["qvel"][:, 2]
    assert (fall > -9.81 / 148 - 1e-9).all() and (fall < -9.81 / 148 + 1e-9).any()
    path = env.rollout(75, break_when_any_done=False)
    height = path["next", "qpos"][..., 2]
    assert (
        path["next", "truncated"][:, 73].all() and not path["next", "terminated"].any()
    )
    assert not path["next", "reward"].any() and height.min() > 0.04
