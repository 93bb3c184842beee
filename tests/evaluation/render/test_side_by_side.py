"""Both rollouts start alike; in closed loop each is driven by its own observation."""

import pytest
import torch

from torchrl_nerd.evaluation.policy import Policy, make_actor
from torchrl_nerd.evaluation.render.side_by_side import roll_out_both
from torchrl_nerd.robots import make_task

STEPS = 6
BOTH = ("nerd", "mujoco")


@pytest.mark.parametrize("frame_stack", [1, 3])
@pytest.mark.parametrize("task_id", ["ant/run", "cube_slope/toss", "franka/reach"])
def test_equal_dynamics_give_equal_rollouts(task_id, frame_stack, seed):
    task = make_task(task_id)
    sizes = (frame_stack * task.observation_size, 8, task.controller.num_actions)
    policy = Policy(sizes, frame_stack=frame_stack)
    torch.nn.init.normal_(policy.mlp[-1].weight)
    actor = make_actor(policy.eval())
    pair = roll_out_both(task_id, ("mujoco", "mujoco"), actor, STEPS, seed)
    assert torch.equal(*pair.paths) and torch.equal(*pair.returns)
    assert len(pair.paths[0]) == len(pair.returns[0]) == STEPS + 1
    assert not torch.equal(pair.paths[0][0], pair.paths[0][-1])
    assert pair.seconds == pytest.approx(STEPS * pair.step_size)


@pytest.mark.parametrize("closed_loop", [True, False])
def test_in_closed_loop_the_policy_acts_on_what_it_sees(closed_loop, seed):
    seen: list[torch.Tensor] = []

    def actor(shown):
        seen.append(shown["qpos"][0].clone())
        return shown.set("action", torch.full((1, 1), 0.3 if len(seen) % 2 else -0.3))

    pair = roll_out_both("cartpole/swingup", BOTH, actor, STEPS, seed, closed_loop)
    learned, ground_truth = pair.paths
    assert pair.kinds == ["learned", "ground truth"]
    assert torch.equal(learned[0], ground_truth[0]) and not torch.equal(
        learned[2], ground_truth[2]
    )
    assert torch.equal(torch.stack(seen[0::2]), learned[:-1])
    assert torch.equal(torch.stack(seen[1::2]), ground_truth[:-1])
    # the policy pushes the two carts to opposite sides; in open loop to the same
    assert (abs(learned[-1] - ground_truth[-1]).max() > 1e-3) == closed_loop


def test_random_actions_are_those_of_their_seed_and_the_same_in_both(seed):
    def path(actor, seed):
        pair = roll_out_both("ant/run", ("mujoco", "mujoco"), actor, STEPS, seed)
        assert torch.equal(*pair.paths)
        return pair.paths[0]

    first, same, other = (path("random", s) for s in (seed, seed, seed + 1))
    assert torch.equal(first, same) and not torch.equal(first, other)
    assert torch.equal(path("zero", seed)[0], first[0])
    assert not torch.equal(path("zero", seed), first)


def test_the_rollouts_end_with_the_first_episode(seed):
    """Full force to one side takes the cart off its rail."""
    pair = roll_out_both(
        "cartpole/swingup",
        BOTH,
        lambda td: td.set("action", torch.ones(1, 1)),
        300,
        seed,
    )
    assert pair.ending in ("nerd terminated", "mujoco terminated")
    assert len(pair.paths[0]) == len(pair.paths[1]) < 301
    state = {"qpos": pair.paths[1][-2], "qvel": torch.zeros(2, dtype=torch.float64)}
    assert not make_task("cartpole/swingup").terminated(state)
