"""``nerd plot``: a figure, its numbers, refusals."""

import json

import pytest

from torchrl_nerd.cli import main


def test_rollouts_are_plotted(tmp_path, seed, capsys):
    out, results = tmp_path / "a.png", tmp_path / "a.json"
    argv = [
        "plot",
        "double_pendulum",
        "--trajectories",
        "4",
        "--steps",
        "5",
        "--case",
        "terrain 1",
    ]
    argv += ["--seed", str(seed), "--out", str(out), "--json", str(results)]
    assert main(argv) == 0
    assert f"{out}: 4 trajectories of 5 steps, terrain 1" in capsys.readouterr().out
    content = json.loads(results.read_text())
    assert out.exists() and len(content["seconds"]) == 6
    assert content["dynamics"] == ["double_pendulum", "MuJoCo"]
    assert all(
        len(content[key][i]) == 6 for key in ("energies", "distances") for i in (0, 1)
    )


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        ("plot unicorn", "'unicorn'"),
        ("plot cartpole --case gorge", "unknown case 'gorge', expected one of passive"),
        ("plot cartpole --trajectories 1", "trajectories of at least 2, got 1"),
        ("plot cartpole --steps 0", "steps of at least 1, got 0"),
        ("data cube --from a.npz --policy p", "--policy without --from"),
    ],
)
def test_bad_input_is_refused(argv, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(argv.split()) == 2
    said = capsys.readouterr().err
    assert words in said and said.count("\n") == 1
    assert not list(tmp_path.iterdir())
