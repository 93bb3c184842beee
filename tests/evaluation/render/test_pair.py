"""Both sides of a film begin alike and are pushed alike."""

import pytest
import torch

from torchrl_nerd.evaluation.policy import Policy, make_actor
from torchrl_nerd.evaluation.render.pair import follow, idle, play_pair
from torchrl_nerd.robots import make_task

STEPS = 8


def policy_of(task_id: str, frame_stack: int):
    task = make_task(task_id)
    sizes = (frame_stack * task.observation_size, 8, task.controller.num_actions)
    policy = Policy(sizes, frame_stack=frame_stack)
    torch.nn.init.normal_(policy.mlp[-1].weight)
    return follow(make_actor(policy.eval()))


def test_equal_dynamics_have_no_error(task_id, seed):
    acts = {0: idle(make_task(task_id), STEPS, seed, "random")}
    acts |= {frame_stack: policy_of(task_id, frame_stack) for frame_stack in (1, 3)}
    for frame_stack, act in acts.items():
        how = {"own_actions": frame_stack > 0, "frame_stack": max(frame_stack, 1)}
        pair = play_pair(task_id, "mujoco", act, STEPS, seed, **how)
        assert torch.equal(pair.learned, pair.truth)
        assert max(float(error.max()) for error in pair.errors.values()) < 1e-6
        assert pair.returns[0] == pair.returns[1]
        assert len(pair.truth) == STEPS + 1 or pair.ending != "steps"
        assert not torch.equal(pair.truth[0], pair.truth[-1])


@pytest.mark.parametrize("name", ["cartpole/swingup", "double_pendulum/passive"])
def test_learned_motion_starts_where_the_true_one_does(name, seed):
    act = idle(make_task(name), STEPS, seed, "random")
    pair = play_pair(name, "nerd", act, STEPS, seed)
    assert torch.equal(pair.learned[0], pair.truth[0])
    assert not torch.equal(pair.learned[1], pair.truth[1])
    again = play_pair(name, "nerd", act, STEPS, seed)
    assert torch.equal(pair.learned, again.learned)


def test_idle_actions_are_those_of_their_seed(task_id, seed):
    task = make_task(task_id)
    draws = [idle(task, STEPS, s, "random") for s in (seed, seed, seed + 1)]
    first, same, other = (torch.cat([d(i, {}) for i in range(STEPS)]) for d in draws)
    assert torch.equal(first, same) and (first.abs() <= 1.0).all()
    assert first.shape == (STEPS, task.controller.num_actions)
    assert first.numel() == 0 or not torch.equal(first, other)
    assert not idle(task, STEPS, seed, "zero")(0, {}).any()


def test_a_film_ends_with_the_true_episode(seed):
    """Full force to one side takes the cart off its rail."""
    task = make_task("cartpole/swingup")
    pair = play_pair(
        "cartpole/swingup", "mujoco", lambda step, shown: torch.ones(1, 1), 300, seed
    )
    assert pair.ending == "terminated" and len(pair.truth) < 302
    state = {"qpos": pair.truth[-2], "qvel": torch.zeros(2, dtype=torch.float64)}
    assert not task.terminated(state)
