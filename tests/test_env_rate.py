"""The benchmark of whole envs, at a tiny budget."""

import json

import env_rate
import pytest


@pytest.mark.slow  # compiles
def test_all_take_their_turns(capsys, tmp_path, seed):
    file = tmp_path / "rates.json"
    tasks, batches = ("cartpole/swingup",), (2, 3)
    env_rate.main(env_rate.Options(tasks, batches, rounds=1, seed=seed, json=file))
    found = json.loads(file.read_text())["results"]["tasks"]["cartpole/swingup"]
    names = {"cartpole", "cartpole-mlp"}
    assert {row["dynamics"] for row in found["first_steps"]} == names
    ways = {(x["dynamics"], x["compiled"], x["num_envs"]) for x in found["rates"]}
    learned = {(name, x, n) for name in names for x in (False, True) for n in batches}
    assert ways == learned | {("mujoco", False, n) for n in batches}
    assert all(row["steps_per_s"] > 0.0 for row in found["rates"])
    assert len(capsys.readouterr().out.splitlines()) == 2 + len(ways)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (env_rate.Options(rounds=0), "rounds"),
        (env_rate.Options(num_envs=(2, 0)), "num_envs 0"),
    ],
)
def test_nothing_to_time_is_refused(options, named):
    with pytest.raises(ValueError, match=f"expected {named}.*got 0"):
        env_rate.main(options)
