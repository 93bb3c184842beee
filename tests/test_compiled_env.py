"""The benchmark of compiled envs, at a tiny budget."""

import compiled_env
import pytest


@pytest.mark.slow  # compiles
def test_both_take_their_turns(capsys, seed):
    options = compiled_env.Options(
        ("cartpole/swingup",), num_envs=2, rounds=1, seed=seed
    )
    compiled_env.main(options)
    *_, line = capsys.readouterr().out.splitlines()
    name, *results = line.split()
    assert name == "cartpole/swingup"
    assert all(float(figure) > 0.0 for figure in results)
