"""The rate of PPO, at a tiny budget: every dynamics has one, MuJoCo's ratio is one."""

from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.fixture
def ppo_rate(monkeypatch, seed):
    """The benchmark, which imports an example."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    import ppo_rate

    return ppo_rate


def test_every_dynamics_takes_its_turns(ppo_rate, capsys, seed):
    options = ppo_rate.Options(
        tasks=("cartpole/swingup",), rounds=1, num_envs=2, compile=False, seed=seed
    )
    found = ppo_rate.main(options)["cartpole/swingup"]
    assert set(found) == {"MuJoCo", "NeRD"} and found["MuJoCo"].ratio == 1.0
    for speed in found.values():
        assert speed.collected_per_s > speed.frames_per_s > 0.0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()[1:]]
    assert [row[1] for row in rows] == ["MuJoCo", "NeRD"]


def test_every_task_with_a_goal_and_a_model_is_one_of_its_tasks(ppo_rate):
    tasks = ppo_rate.default_tasks()
    assert {"cartpole/swingup", "ant/run", "anymal/forward"} <= set(tasks)
    with pytest.raises(ValueError, match="expected tasks among .*, got cube/toss"):
        ppo_rate.main(ppo_rate.Options(tasks=("cube/toss",)))
