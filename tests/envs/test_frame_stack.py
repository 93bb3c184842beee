"""Policies that see their last observations, in envs and in loops without one."""

import pytest
import torch
from torchrl.envs.utils import check_env_specs

from torchrl_nerd.envs import make_env
from torchrl_nerd.envs.frame_stack import append_frame, stack_frames
from torchrl_nerd.robots import make_task

ROWS, STEPS = 4, 6


@pytest.fixture(params=["nerd", "mujoco"])
def dynamics(request) -> str:
    return request.param


def test_one_observation_is_the_env_itself(dynamics):
    env = make_env("franka/reach", dynamics, ROWS)
    assert stack_frames(env, 1) is env


@pytest.mark.parametrize("frame_stack", [2, 3])
def test_it_shows_what_was_seen(frame_stack, dynamics, seed):
    env, plain = (make_env("franka/reach", dynamics, ROWS, seed) for _ in range(2))
    env = stack_frames(env, frame_stack)
    check_env_specs(env)
    env.set_seed(seed)
    plain.set_seed(seed)
    actions = torch.rand(STEPS, ROWS, 7) * 2.0 - 1.0
    td, one = env.reset(), plain.reset()
    recent = append_frame(None, one["observation"], frame_stack)
    assert torch.equal(td["observation"], recent)
    for action in actions:
        td = env.step(td.set("action", action))["next"]
        one = plain.step(one.set("action", action))["next"]
        recent = append_frame(recent, one["observation"], frame_stack)
        assert torch.equal(td["observation"], recent)


def test_a_partial_reset_forgets_its_rows_alone(dynamics, seed):
    env = stack_frames(make_env("franka/reach", dynamics, ROWS, seed), 3)
    last = env.rollout(4, break_when_any_done=False)[:, -1]["next"].clone()
    which = torch.tensor([False, True, True, False])
    again = env.reset(last.clone().set("_reset", which[:, None]))["observation"]
    assert torch.equal(again[~which], last["observation"][~which])
    first = again[which].unflatten(-1, (3, -1))
    assert torch.equal(first, first[:, :1].expand_as(first))


def test_no_memory_at_all_is_refused():
    task = make_task("cartpole/swingup")
    with pytest.raises(ValueError, match="frame_stack"):
        stack_frames(make_env(task, "mujoco"), 0)


def test_held_envs_keep_their_frames(dynamics, seed):
    env = stack_frames(make_env("franka/reach", dynamics, ROWS, seed), 3)
    last = env.rollout(4, break_when_any_done=False)[:, -1]["next"].clone()
    moves = torch.tensor([True, False, True, False])
    given = {"action": env.rand_action()["action"], "_step": moves}
    after = env.step(last.clone().update(given))["next"]
    still = (after["observation"] == last["observation"]).all(-1)
    assert torch.equal(still, ~moves)
    action = env.rand_action()["action"]
    later = env.step(after.exclude("reward").set("action", action))["next"]
    assert torch.equal(later["observation"][:, :26], after["observation"][:, 13:])
