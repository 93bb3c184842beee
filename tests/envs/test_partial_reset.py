"""A partial reset starts its rows anew and is unnoticed by all the others."""

import pytest
import torch
from dynamics_helpers import (
    EnvMaker,
    act_all,
    assert_same_motion,
    each_dynamics,
    random_actions,
    random_mask,
    reset_rows,
    start_at,
    unequal_keys,
)
from torchrl.envs.utils import step_mdp

ROWS, STEPS = 5, 4


@each_dynamics
def test_other_rows_go_on_bitwise(task_id, dynamics, generator):
    make = EnvMaker(task_id, dynamics, generator)
    env, undisturbed = make(ROWS), make(ROWS)
    actions = random_actions(env, 2 * STEPS, generator)
    for each in (env, undisturbed):
        each.reset()
        before = act_all(each, actions[:STEPS])[:, -1]
    rows = random_mask(ROWS, generator)
    state = reset_rows(env, rows, before)
    for key in ("qpos", "qvel", "observation"):
        assert torch.equal(state[key][~rows], before[key][~rows]), key
        assert not torch.equal(state[key][rows], before[key][rows]), key
    after, expected = (act_all(each, actions[STEPS:]) for each in (env, undisturbed))
    assert not unequal_keys(after[~rows], expected[~rows])
    assert (after["qpos"][rows] != expected["qpos"][rows]).any(-1).all()


@each_dynamics
def test_a_reset_row_is_like_one_in_a_fresh_env(task_id, dynamics, generator):
    make = EnvMaker(task_id, dynamics, generator)
    env, fresh = make(ROWS), make(ROWS)
    actions = random_actions(env, 2 * STEPS, generator)
    env.reset()
    act_all(env, actions[:STEPS])
    rows = random_mask(ROWS, generator)
    reset_rows(env, rows)
    start_at(fresh, env.state)
    after, expected = (act_all(each, actions[STEPS:])[rows] for each in (env, fresh))
    assert_same_motion(after, expected, 1e-6 if dynamics == "streaming" else 0.0)


@each_dynamics
def test_the_age_of_a_row_is_its_own(task_id, dynamics, generator):
    """Truncation counts from each env's own reset."""
    horizon = 5
    env = EnvMaker(task_id, dynamics, generator, horizon)(2)
    later = int(torch.randint(1, horizon, (), generator=generator))
    env.reset()
    ends = []
    for step, action in enumerate(random_actions(env, horizon + later, generator)):
        if step == later:
            reset_rows(env, torch.tensor([False, True]))
        ends.append(act_all(env, action[None])["truncated"][:, 0, 0].tolist())
    assert [row for row, _ in ends].index(True) + 1 == horizon
    assert [row for _, row in ends].index(True) + 1 == horizon + later


@each_dynamics
def test_an_empty_mask_resets_nothing(task_id, dynamics, generator):
    make = EnvMaker(task_id, dynamics, generator)
    env, undisturbed = make(ROWS), make(ROWS)
    actions = random_actions(env, 2 * STEPS, generator)
    for each in (env, undisturbed):
        each.reset()
        act_all(each, actions[:STEPS])
    reset_rows(env, torch.zeros(ROWS, dtype=torch.bool))
    after, expected = (act_all(each, actions[STEPS:]) for each in (env, undisturbed))
    assert not unequal_keys(after, expected)


@pytest.mark.parametrize("dynamics", ["streaming", "mujoco"])
def test_automatic_resets_equal_resets_by_hand(task_id, dynamics, generator):
    make = EnvMaker(task_id, dynamics, generator, horizon=4)
    automatic, manual = make(ROWS), make(ROWS)
    actions = random_actions(automatic, 11, generator)
    rows = random_mask(ROWS, generator)
    for each in (automatic, manual):  # rows of two ages, so that resets are partial
        each.reset()
        act_all(each, actions[:2])
        state = reset_rows(each, rows, each.state)
    by_hand, resets = state.clone(), 0
    for action in actions[2:]:
        record, state = automatic.step_and_maybe_reset(state.set("action", action))
        step = manual.step(by_hand.set("action", action))
        assert not unequal_keys(record["next"], step["next"])
        by_hand = step_mdp(step)
        done = step["next", "done"][:, 0]
        if done.any():
            by_hand = manual.reset(
                by_hand.set("_reset", done[:, None]), set_state=False
            )
            resets += int(not done.all())
        for key in ("qpos", "qvel", "observation", "done"):
            assert torch.equal(state[key], by_hand[key]), key
    assert resets > 0
