"""The benchmark of whole envs, at a tiny budget."""

import json

import env_rate
import pytest
import tables


@pytest.mark.slow  # compiles
def test_all_take_their_turns(capsys, tmp_path, seed):
    file = tmp_path / "env_rate.json"
    task, batches = "cartpole/swingup", (2, 3)
    env_rate.main(env_rate.Options((task,), batches, rounds=2, seed=seed, json=file))
    found = json.loads(file.read_text())["results"]["tasks"][task]
    names = {"cartpole", "cartpole-mlp"}
    ways = {(x["dynamics"], x["compiled"], x["num_envs"]) for x in found}
    learned = {(name, x, n) for name in names for x in (False, True) for n in batches}
    assert ways == learned | {("mujoco", False, n) for n in batches}
    assert all(row["steps_per_s"] > 0.0 for row in found)
    assert all(row["cold_s"] > row["warm_s"] for row in found if row["compiled"])
    assert len(capsys.readouterr().out.splitlines()) == len(ways)
    assert "cartpole-mlp, compiled" in tables.env_table(tmp_path)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (env_rate.Options(rounds=1), "rounds of at least 2, got 1"),
        (env_rate.Options(num_envs=(2, 0)), "num_envs 0 of at least 1, got 0"),
    ],
)
def test_nothing_to_time_is_refused(options, named):
    with pytest.raises(ValueError, match=f"expected {named}"):
        env_rate.main(options)
