"""The benchmark of streaming against the window, at a tiny budget."""

import json

import streaming


def test_a_row_for_every_preset(capsys, seed, tmp_path):
    path = tmp_path / "streaming.json"
    options = streaming.Options(
        "cartpole",
        ("transformer-2x64",),
        num_envs=2,
        rounds=1,
        compile=False,
        seed=seed,
        json=path,
    )
    options.threads = 1
    (found,) = streaming.main(options)
    assert found.preset == "transformer-2x64" and not found.is_compiled
    assert found.ratio == found.streaming_per_s / found.window_per_s > 0.0
    assert "transformer-2x64" in capsys.readouterr().out.splitlines()[-1]
    assert json.loads(path.read_text())["results"]["speeds"][0]["ratio"] == found.ratio
