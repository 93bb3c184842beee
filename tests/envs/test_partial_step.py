"""Envs whose ``_step`` is False take no part in a step."""

import pytest
import torch
from dynamics_helpers import (
    EnvMaker,
    act,
    act_all,
    assert_same_motion,
    double_model,
    random_actions,
    random_drive,
    random_mask,
    roll,
    unequal_keys,
    warp_too,
)
from tensordict import TensorDict
from torchrl.envs import TransformedEnv
from torchrl.envs.transforms import ConditionalSkip, MultiAction

from torchrl_nerd.dynamics import NeRDDynamics
from torchrl_nerd.robots import load_scene

ROWS, STEPS = 4, 3


@warp_too
def test_held_envs_stay_as_they_are_and_the_others_move_on(
    task_id, dynamics, generator
):
    """State, history, age and random stream: what comes later is as if never held."""
    make = EnvMaker(task_id, dynamics, generator, horizon=3 * STEPS - 1)
    env, whole = make(ROWS), make(ROWS)
    actions = random_actions(env, 3 * STEPS, generator)
    for each in (env, whole):
        each.reset()
        before = act_all(each, actions[:STEPS])[:, -1]
    held = random_mask(ROWS, generator)
    shown = before.clone()
    for action in actions[STEPS : 2 * STEPS]:
        given = TensorDict({"action": action, "_step": ~held}, [ROWS])
        shown = env.step(given.update(shown.select("done", "fault")))["next"]
        expected = act(whole, action)
        assert not unequal_keys(shown[~held], expected[~held])
        for key in ("qpos", "qvel", "observation", "done"):
            assert torch.equal(shown[key][held], before[key][held]), key
        assert not shown["reward"][held].any()
    later = act_all(env, actions[-STEPS:])
    assert later["truncated"][~held, -2].all() and not later["truncated"][held].any()
    undisturbed = make(ROWS)
    undisturbed.reset()
    act_all(undisturbed, actions[:STEPS])
    expected = act_all(undisturbed, actions[-STEPS:])
    # another place in the ring of keys and values sums in another order
    tolerance = 1e-6 if dynamics == "streaming" else 0.0
    assert_same_motion(later[held], expected[held], tolerance)
    expected = act_all(whole, actions[-STEPS:])
    assert not unequal_keys(later[~held], expected[~held])
    again, expected = (each.reset() for each in (env, undisturbed))
    assert torch.equal(again["qpos"], expected["qpos"])


@pytest.mark.parametrize(
    ("inference", "network"),
    [("streaming", "transformer-2x64"), ("streaming", "gru"), ("window", "mlp-2x32")],
)
def test_every_history_can_be_taken_back(inference, network, generator):
    """Whatever the number of steps since, with gradients or without."""
    scene = load_scene("cartpole")
    model = double_model(scene, generator, network)
    start, torques, terrain = random_drive(scene, ROWS, 15, generator)
    for is_differentiable in (False, True):
        dynamics = NeRDDynamics(model, inference, differentiable=is_differentiable)
        middle = roll(dynamics, start, torques[:11], terrain)[:, -1]
        past = dynamics.history()
        first = roll(dynamics, middle, torques[11:], terrain)
        dynamics.restore(past, torch.ones(ROWS, dtype=torch.bool))
        again = roll(dynamics, middle, torques[11:], terrain)
        assert_same_motion(again, first, 1e-9)


@pytest.mark.parametrize("dynamics", ["streaming", "mujoco"])
def test_torchrl_skips_and_stops_envs(dynamics, generator):
    make = EnvMaker("cartpole/swingup", dynamics, generator, horizon=5)
    base = make(ROWS)
    rows = random_mask(ROWS, generator)
    skipping = TransformedEnv(base, ConditionalSkip(lambda td: rows[:, None]))
    path = skipping.rollout(3, break_when_any_done=False)
    still = path["next", "qpos"] == path["qpos"][:, :1]
    assert still[rows].all() and not still[~rows].any()

    several = TransformedEnv(make(ROWS), MultiAction(stack_rewards=False))
    td = several.reset()
    rest = several.base_env.state
    action = torch.zeros(ROWS, 3, base.action_spec.shape[-1])
    action[0, 0] = torch.nan  # ends the first env before the others
    after = several.step(td.set("action", action))["next"]
    assert after["terminated"][:, 0].tolist() == [i == 0 for i in range(ROWS)]
    assert torch.equal(several.base_env.state["qpos"][0], rest["qpos"][0])
    assert several.base_env._age.tolist() == [1, 3, 3, 3]


def test_a_rollout_until_all_are_done_moves_no_env_that_is(generator):
    env = EnvMaker("cartpole/swingup", "streaming", generator, horizon=4)(ROWS)
    td = env.reset()
    env._age[0] = 2  # whose episode is over two steps earlier
    path = env.rollout(
        9,
        auto_reset=False,
        tensordict=td,
        break_when_any_done=False,
        break_when_all_done=True,
    )
    assert path.shape == (ROWS, 4)
    assert torch.equal(env.state["qpos"][0], path["next", "qpos"][0, 1])
