"""``nerd plot``: files, figures, refusals."""

import json

import pytest

from torchrl_nerd.cli import main


def test_rollouts_are_plotted(tmp_path, seed, capsys):
    out, figures = tmp_path / "a.png", tmp_path / "a.json"
    argv = [
        "plot",
        "double_pendulum",
        "--rows",
        "4",
        "--steps",
        "5",
        "--case",
        "ground 1",
    ]
    argv += ["--seed", str(seed), "--out", str(out), "--json", str(figures)]
    assert main(argv) == 0
    assert f"{out}: double_pendulum, ground 1" in capsys.readouterr().out
    content = json.loads(figures.read_text())
    assert out.exists() and len(content["seconds"]) == 6
    assert set(content["energies"]) == set(content["gaps"]) == {"learned", "MuJoCo"}


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        ("plot unicorn", "'unicorn'"),
        ("plot cartpole --case gorge", "unknown case 'gorge', expected one of passive"),
        ("plot cartpole --rows 1", "rows of at least 2, got 1"),
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
