"""A fault stays in its row, ends it, and is gone after its reset."""

import pytest
import torch
from dynamics_helpers import (
    EnvMaker,
    act,
    act_all,
    assert_same_motion,
    each_dynamics,
    each_with_actions,
    inference_of,
    junk_fill,
    random_actions,
    reset_rows,
    start_at,
    unequal_keys,
)
from safetensors import safe_open
from tensordict import TensorDict

from torchrl_nerd import GroundTruthEnv, NeRDEnv
from torchrl_nerd.envs.faults import REASONS

ROWS, STEPS = 4, 3
each_junk = pytest.mark.parametrize("junk", [float("nan"), float("inf"), -float("inf")])


@each_with_actions
@each_dynamics
@each_junk
def test_a_bad_action_ends_its_own_row_alone(task_id, dynamics, junk, generator):
    make = EnvMaker(task_id, dynamics, generator)
    env, sound = make(ROWS), make(ROWS)
    actions = random_actions(env, 3 * STEPS, generator)
    row = int(torch.randint(ROWS, (), generator=generator))
    bad = actions[STEPS].clone()
    bad[row, int(torch.randint(bad.shape[1], (), generator=generator))] = junk
    others = torch.arange(ROWS) != row
    for each in (env, sound):
        each.reset()
        before = act_all(each, actions[:STEPS])[:, -1]

    faulty, expected = act(env, bad), act(sound, actions[STEPS])
    assert not unequal_keys(faulty[others], expected[others])
    assert faulty["terminated"][row] and faulty["done"][row]
    assert not faulty["truncated"][row]
    for key in ("observation", "reward", "qpos", "qvel", "joint_torque"):
        assert faulty[key].isfinite().all(), key
    assert torch.equal(faulty["qpos"][row], before["qpos"][row])

    reset_rows(env, ~others)
    start = env.state
    after, expected = (act_all(each, actions[-STEPS:]) for each in (env, sound))
    assert not unequal_keys(after[others], expected[others])
    clean = make(ROWS)
    start_at(clean, start)
    fresh = act_all(clean, actions[-STEPS:])
    tolerance = 1e-6 if dynamics == "streaming" else 0.0
    assert_same_motion(after[row], fresh[row], tolerance)


@each_dynamics
def test_a_row_that_the_physics_cannot_step_ends_alone(task_id, dynamics, generator):
    make = EnvMaker(task_id, dynamics, generator)
    env, sound = make(ROWS), make(ROWS)
    start = sound.reset()
    row = int(torch.randint(ROWS, (), generator=generator))
    others = torch.arange(ROWS) != row
    wild = start.clone()
    wild["qvel"][row] = 1e300
    start_at(env, wild)
    start_at(sound, start)
    actions = random_actions(env, 2 * STEPS, generator)
    first, expected = (act(each, actions[0]) for each in (env, sound))
    assert not unequal_keys(first[others], expected[others])
    assert first["terminated"][row]
    assert first["qpos"].isfinite().all() and first["qvel"].isfinite().all()
    reset_rows(env, ~others)
    after, expected = (act_all(each, actions[1:]) for each in (env, sound))
    assert not unequal_keys(after[others], expected[others])
    state = torch.cat((after["qpos"], after["qvel"], after["reward"]), -1)
    assert state.isfinite().all()


@each_dynamics
@pytest.mark.parametrize(
    ("key", "junk"), [("qvel", 1e12), ("qvel", -1e5), ("qpos", 1e12)]
)
def test_huge_and_finite_is_a_fault_of_its_row(task_id, dynamics, key, junk, generator):
    make = EnvMaker(task_id, dynamics, generator)
    env, sound = make(ROWS), make(ROWS)
    start = sound.reset()
    row = int(torch.randint(ROWS, (), generator=generator))
    others = torch.arange(ROWS) != row
    wild = start.clone()
    wild[key][row, 0] = junk
    start_at(env, wild)
    start_at(sound, start)
    action = random_actions(env, 1, generator)[0]
    after, expected = act(env, action), act(sound, action)
    assert after["terminated"][row] and after["fault"][row] in (2, 3)
    assert not after["fault"][others].any()
    assert not unequal_keys(after[others], expected[others])


@each_with_actions
@each_dynamics
def test_actions_beyond_the_limits_act_like_the_limits(task_id, dynamics, generator):
    make = EnvMaker(task_id, dynamics, generator)
    env, limited = make(ROWS), make(ROWS)
    for each in (env, limited):
        each.reset()
    actions = 50.0 * random_actions(env, STEPS, generator)
    after, expected = act_all(env, actions), act_all(limited, actions.clamp(-1.0, 1.0))
    assert torch.equal(after["qpos"], expected["qpos"])


@each_dynamics
def test_collected_data_never_alias_the_env(task_id, dynamics, generator):
    """Junk written into all that an env returned changes nothing in it."""
    make = EnvMaker(task_id, dynamics, generator)
    env, sound = make(ROWS), make(ROWS)
    actions = random_actions(env, 4 * STEPS, generator)
    junk_fill(env.reset())
    sound.reset()
    kept, copies = [], []
    for step, action in enumerate(actions):
        if step == 2 * STEPS:
            rows = torch.tensor([True, False, True, False])
            given = TensorDict({"_reset": rows[:, None]}, [ROWS])
            junk_fill(env.reset(given))
            reset_rows(sound, rows)
        record = env.step(TensorDict({"action": action.clone()}, [ROWS]))
        kept.append(sound.step(TensorDict({"action": action.clone()}, [ROWS])))
        copies.append(kept[-1].clone())
        assert not unequal_keys(record["next"], kept[-1]["next"])
        junk_fill(record)
        junk_fill(env.state)
    for record, copy in zip(kept, copies, strict=True):
        assert not unequal_keys(record, copy)


@each_dynamics
def test_a_given_state_is_copied(task_id, dynamics, generator):
    make = EnvMaker(task_id, dynamics, generator)
    env, sound = make(ROWS), make(ROWS)
    start = sound.reset()
    start_at(sound, start)
    given = start.clone()
    env.reset(given, set_state=True)
    junk_fill(given)
    action = random_actions(env, 1, generator)[0]
    assert not unequal_keys(act(env, action), act(sound, action))


@each_dynamics
def test_a_fault_is_named_and_leaves_a_dump_once(dynamics, generator, tmp_path):
    make = EnvMaker("ant/run", dynamics, generator)
    model = make.model
    if model is None:
        env = GroundTruthEnv("ant/run", dynamics, ROWS, dump_dir=tmp_path)
    else:
        inference = inference_of(dynamics)
        env = NeRDEnv("ant/run", model, ROWS, inference=inference, dump_dir=tmp_path)
    env.reset()
    actions = random_actions(env, 5, generator)
    act_all(env, actions[:2])
    env.reset()  # the dump begins here
    row = int(torch.randint(ROWS, (), generator=generator))
    good = act_all(env, actions[:3])
    assert not good["fault"].any() and not list(tmp_path.iterdir())
    bad = actions[3].clone()
    bad[row, 0] = torch.nan
    after = act(env, bad)
    assert after["fault"][:, 0].tolist() == [int(i == row) for i in range(ROWS)]
    (path,) = tmp_path.iterdir()
    with safe_open(path, framework="pt") as file:
        about, dump = file.metadata(), {k: file.get_tensor(k) for k in file.keys()}  # noqa: SIM118
    assert about["reason"] == "action" and about["env"] == str(row)
    assert torch.equal(dump["qpos"][1:], good["qpos"][row])
    stamp = path.stat().st_mtime_ns
    act(env, bad)
    assert path.stat().st_mtime_ns == stamp
    assert all(len(value) == 4 for value in dump.values())


@pytest.mark.parametrize("task_id", ["franka/reach", "franka/reach_osc"])
def test_a_row_that_fails_while_its_action_is_held_hands_out_numbers(
    task_id, generator
):
    """The torque, too, that the next control step would have asked for."""
    env = EnvMaker(task_id, "mujoco", generator)(ROWS)
    start = env.reset().select(*env.state.keys())
    start["qvel"][1] = 5e3
    start_at(env, start)
    after = act(env, random_actions(env, 1, generator)[0])
    assert REASONS[int(after["fault"][1])] == "diverged"
    assert all(value.isfinite().all() for value in after.values())
