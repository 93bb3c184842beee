import math

import pytest
import torch
from scipy import stats
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn

from torchrl_nerd import make_env
from torchrl_nerd.evaluation.policy import (
    Policy,
    Standardize,
    load_policy,
    make_actor,
    save_policy,
)
from torchrl_nerd.evaluation.policy_transfer import (
    policy_returns,
    summarize,
    transfer,
    transfer_table,
)
from torchrl_nerd.robots import make_task

TASK = "cartpole/swingup"


def brake_and_hold() -> TensorDictModule:
    """Linear feedback: some rows survive, some run off the rail."""
    linear = nn.Linear(4, 1, bias=False)
    linear.weight.data = torch.tensor([[0.1, 1.0, 0.2, 0.3]])
    return TensorDictModule(linear, ["observation"], ["action"])


@pytest.fixture
def policy() -> Policy:
    torch.manual_seed(0)
    policy = Policy((4, 16, 16, 1))
    policy.standardize.fit(torch.randn(50, 4) * 3.0 + 1.0)
    return policy


def test_returns_equal_a_loop_over_rows_that_stops_at_each_end() -> None:
    actor = brake_and_hold()
    returns = policy_returns(make_env(TASK, "mujoco", num_envs=16, seed=3), actor)
    env = make_env(TASK, "mujoco", num_envs=16, seed=3)
    with torch.no_grad():
        steps = env.rollout(300, actor, break_when_any_done=False)["next"]
    lengths = []
    for row in range(16):
        total = 0.0
        for step in range(300):
            total += steps["reward"][row, step].item()
            if steps["done"][row, step]:
                break
        lengths.append(step + 1)
        assert returns[row].item() == pytest.approx(total, rel=1e-12)
    assert min(lengths) < 300 and max(lengths) == 300


def test_returns_do_not_depend_on_other_rows() -> None:
    actor = brake_and_hold()
    few, many = (
        policy_returns(make_env(TASK, "mujoco", num_envs=rows, seed=1), actor)
        for rows in (4, 9)
    )
    assert torch.equal(few, many[:4])


def test_returns_take_the_mean_action(policy: Policy) -> None:
    returns = [
        policy_returns(make_env(TASK, "mujoco", num_envs=4, seed=1), make_actor(policy))
        for _ in range(2)
    ]
    assert torch.equal(*returns)


def test_summary_of_known_returns() -> None:
    ground_truth = torch.tensor([100.0, 300.0], dtype=torch.float64)
    summary = summarize(
        torch.tensor([110.0, 330.0, 0.0], dtype=torch.float64), ground_truth
    )
    assert summary.episodes == 3
    assert summary.mean == pytest.approx(440.0 / 3.0)
    assert summary.difference == pytest.approx(0.1)
    spread = torch.tensor([10.0, 30.0]).std().item()
    half = stats.t.ppf(0.975, 1) * spread / 2**0.5
    assert summary.difference_interval == pytest.approx(half / 200.0)


def test_an_interval_needs_two_episodes() -> None:
    with pytest.raises(ValueError, match="expected at least 2 episodes"):
        summarize(torch.ones(1), torch.ones(1))


def test_a_policy_without_reward_has_no_difference() -> None:
    """A sparse task at the beginning of learning: a table all the same."""
    summary = summarize(torch.ones(5), torch.zeros(5))
    assert summary.mean == 1.0 and math.isnan(summary.difference)
    assert "nan" not in transfer_table({"nerd": summary})


def test_mujoco_engines_agree_and_ground_truth_is_added(policy: Policy) -> None:
    summaries = transfer(TASK, make_actor(policy), ["dm_control"], 6, slow_episodes=3)
    assert {name: s.episodes for name, s in summaries.items()} == {
        "dm_control": 3,
        "mujoco": 6,
    }
    assert abs(summaries["dm_control"].difference) < 1e-6
    assert summaries["mujoco"].difference == 0.0
    table = transfer_table(summaries)
    assert len(table.splitlines()) == 4 and "Return difference: to MuJoCo" in table
    assert {s.kind for s in summaries.values()} == {"ground truth"}


@pytest.mark.parametrize("frame_stack", [1, 3])
def test_policy_survives_disk(frame_stack: int, tmp_path) -> None:
    policy = Policy((4 * frame_stack, 16, 16, 1), frame_stack=frame_stack)
    policy.standardize.fit(torch.randn(50, 4 * frame_stack) * 3.0 + 1.0)
    save_policy(policy, str(tmp_path / "policy"), {"task": TASK})
    loaded = load_policy(str(tmp_path / "policy"), make_task(TASK))
    observation = torch.randn(7, 4 * frame_stack)
    for one, other in zip(policy(observation), loaded(observation), strict=True):
        assert torch.equal(one, other)


def test_constants_are_those_of_all_that_was_seen() -> None:
    batches = [torch.randn(n, 5, 4) * n + n for n in (3, 1, 20)]
    standardize = Standardize(4)
    for batch in batches:
        standardize.fit(batch)
    together = torch.cat(batches).flatten(0, 1).double()
    torch.testing.assert_close(standardize.mean.double(), together.mean(0))
    std = together.std(0, correction=0)
    torch.testing.assert_close(standardize.std.double(), std)


def test_changes_have_a_spread_of_their_own() -> None:
    speed = torch.randn(500, 2)
    path = (
        100.0 * torch.randn(500, 1, 2)
        + 0.01 * torch.arange(3)[:, None] * speed[:, None]
    )
    seen = path.double().flatten(1)
    shown = Standardize(6, frame_stack=3).double().fit(seen)(seen)
    torch.testing.assert_close(shown.std(0), torch.ones(6).double(), rtol=0, atol=0.01)
    for change in (shown[:, 2:4], shown[:, 4:]):  # speed, and nothing else
        matched = torch.corrcoef(torch.stack((change[:, 0], speed[:, 0].double())))
        assert matched[0, 1] > 0.999


def test_actions_stay_in_the_spec(policy: Policy) -> None:
    env = make_env(TASK, "mujoco", num_envs=8)
    rows = TensorDict({"observation": 1e6 * torch.randn(8, 4)}, batch_size=[8])
    with torch.no_grad():
        assert env.action_spec.is_in(make_actor(policy)(rows)["action"])


@pytest.mark.parametrize(
    "damage", ["missing", "truncated", "sizes", "card", "frame_stack", "task"]
)
def test_broken_policies_are_named(damage: str, policy: Policy, tmp_path) -> None:
    save_policy(policy, tmp_path)
    weights, card = tmp_path / "policy.safetensors", tmp_path / "policy.json"
    if damage == "missing":
        weights.unlink()
    elif damage == "truncated":
        weights.write_bytes(weights.read_bytes()[:100])
    elif damage == "sizes":
        card.write_text('{"sizes": [4, 8, 1]}')
    elif damage == "card":
        card.write_text('{"sizes": "many"}')
    elif damage == "frame_stack":
        card.write_text('{"sizes": [4, 16, 16, 1], "frame_stack": 3}')
    task = make_task("double_pendulum/passive") if damage == "task" else None
    with pytest.raises(ValueError, match=str(tmp_path)):
        load_policy(tmp_path, task)


def test_an_unknown_dynamics_is_refused_before_any_episode():
    def actor(tensordict):
        raise AssertionError("an episode began")

    with pytest.raises(ValueError, match="unknown dynamics 'newton'"):
        transfer("cartpole/swingup", actor, ("mujoco", "newton"), episodes=2)
