"""Rows like those of training are stepped as ever; the guard deals with the others."""

import pytest
import torch
from dynamics_helpers import EnvMaker, little_data, random_actions, random_model
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from torchrl_nerd import NeRDEnv
from torchrl_nerd.configs import NO_PREDICTIONS
from torchrl_nerd.dynamics import (
    GuardedDynamics,
    MujocoDynamics,
    NeRDDynamics,
    UntrustedError,
)
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.modules.networks import NETWORKS

ROWS = 12
GUARDS = ("flag", "truncate", "fallback")


def mixed_rows(scene, generator):
    """Training states, every third of them a thousand times too fast; and which."""
    data = little_data(scene).flatten(0, 1)
    rows = data[torch.randperm(len(data), generator=generator)[:ROWS]].clone()
    is_wild = torch.arange(ROWS) % 3 == 0
    rows["qvel"][is_wild] = 1e3 * (1.0 + rows["qvel"][is_wild].abs())
    torque, terrain = rows["next", "joint_torque"], rows.get("terrain", None)
    return rows.select("qpos", "qvel"), torque, terrain, is_wild


@pytest.mark.parametrize("guard", GUARDS)
def test_trusted_rows_move_bitwise_as_without_a_guard(scene, guard, generator):
    model = random_model(scene, generator)
    state, torque, terrain, _ = mixed_rows(scene, generator)
    plain = NeRDDynamics(model).step(state, torque, terrain)
    guarded = GuardedDynamics(NeRDDynamics(model), guard).step(state, torque, terrain)
    trusted = guarded["trust"][:, 0] == 1.0
    for key in ("qpos", "qvel"):
        assert torch.equal(guarded[key][trusted], plain[key][trusted])


def test_what_training_never_saw_is_not_trusted_and_left_to_mujoco(scene, generator):
    model = random_model(scene, generator)
    state, torque, terrain, is_wild = mixed_rows(scene, generator)
    guarded = GuardedDynamics(NeRDDynamics(model), "fallback")
    after = guarded.step(state, torque, terrain)
    assert (after["trust"][is_wild] < 0.5).all()
    rows = after["trust"][:, 0] < 1.0
    ground = None if terrain is None else terrain[rows]
    true = MujocoDynamics(scene).step(state[rows], torque[rows], ground)
    for key in ("qpos", "qvel"):
        assert torch.equal(after[key][rows].nan_to_num(), true[key].nan_to_num())


def test_a_row_goes_back_to_the_model_once_it_has_calmed_down(scene, generator):
    model = random_model(scene, generator)
    state, torque, terrain, is_wild = mixed_rows(scene, generator)
    guarded = GuardedDynamics(NeRDDynamics(model), "fallback")
    guarded.patience = 2
    learned = NeRDDynamics(model)
    calm = state.clone()
    for key in ("qpos", "qvel"):
        calm[key][is_wild] = state[key][~is_wild][: int(is_wild.sum())]
    fresh = GuardedDynamics(NeRDDynamics(model)).step(calm, torque, terrain)
    true = MujocoDynamics(scene).step(calm, torque, terrain)
    rows = is_wild & (fresh["trust"][:, 0] == 1.0)
    for dynamics in (guarded, learned):
        dynamics.step(state, torque, terrain)
    for is_ground_truth in (True, True, False):  # two trusted steps, then the model
        after, mine = (d.step(calm, torque, terrain) for d in (guarded, learned))
        expected = true if is_ground_truth else mine
        assert torch.equal(after["qvel"][rows], expected["qvel"][rows])
    guarded.step(state, torque, terrain)
    guarded.reset(calm, is_wild)  # a fresh row owes nothing to the one before
    after = guarded.step(calm, torque, terrain)
    torch.testing.assert_close(after["qvel"][rows], fresh["qvel"][rows])


def test_a_row_that_is_no_number_has_no_trust(scene, generator):
    model = random_model(scene, generator)
    state, torque, terrain, _ = mixed_rows(scene, generator)
    row = int(torch.randint(ROWS, (), generator=generator))
    state["qvel"][row] = torch.nan
    after = GuardedDynamics(NeRDDynamics(model)).step(state, torque, terrain)
    assert after["trust"][row] == 0.0
    assert after["trust"].isfinite().all()


def test_asked_to_raise_it_names_the_rows(scene, generator):
    model = random_model(scene, generator)
    state, torque, terrain, _ = mixed_rows(scene, generator)
    guarded = GuardedDynamics(NeRDDynamics(model), "raise")
    with pytest.raises(UntrustedError, match=r"of 12 envs beyond them, first env 0"):
        guarded.step(state, torque, terrain)


@pytest.mark.parametrize("guard", GUARDS)
def test_a_guarded_env_keeps_its_specs(task_id, guard, generator):
    task = EnvMaker(task_id, "streaming", generator)
    env = NeRDEnv(task.task, task.model, 2, guard=guard)
    check_env_specs(env)
    assert env.rollout(3, break_when_any_done=False)["next", "trust"].shape == (2, 3, 1)


def test_untrusted_rows_are_cut_short_and_not_ended(task_id, generator):
    make = EnvMaker(task_id, "streaming", generator)
    env = NeRDEnv(make.task, make.model, 2, guard="truncate")
    start = env.reset()
    start["qvel"] = start["qvel"] + 200.0
    env.reset(start, set_state=True)
    action = random_actions(env, 1, generator)[0]
    after = env.step(TensorDict({"action": action}, env.batch_size))["next"]
    assert (after["trust"] < 1.0).all()
    assert after["truncated"].all() and after["done"].all()
    assert not (after["fault"] > 0).any()


def test_bad_arguments_are_named(scene, generator):
    learned = NeRDDynamics(random_model(scene, generator))
    with pytest.raises(ValueError, match="expected a guard of flag, .*, got 'hope'"):
        GuardedDynamics(learned, "hope")  # pyright: ignore
    ignorant = NeRDDynamics(NeRD(scene, NO_PREDICTIONS, NETWORKS["mlp-4x64"]))
    with pytest.raises(ValueError, match="knows what it was trained on"):
        GuardedDynamics(ignorant)


def test_mujoco_steps_rows_of_float32(generator):
    make = EnvMaker("cartpole/swingup", "streaming", generator)
    how = {"guard": "fallback", "state_dtype": torch.float32}
    env = NeRDEnv(make.task, make.model, 2, **how)
    start = env.reset()
    start["qvel"][0] = start["qvel"][0] + 200.0
    env.reset(start, set_state=True)
    action = random_actions(env, 1, generator)[0]
    after = env.step(TensorDict({"action": action}, env.batch_size))["next"]
    assert after["trust"][0] < 1.0 and not after["fault"].any()
    assert after["qvel"].dtype == torch.float32
