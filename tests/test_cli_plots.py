"""``nerd plot`` and ``nerd data --inspect``: files, figures, refusals."""

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


def test_a_data_set_is_inspected(tmp_path, seed, capsys):
    figures = tmp_path / "a.json"
    argv = ["data", "cartpole", "--out", str(tmp_path / "d"), "--trajectories", "20"]
    argv += ["--steps", "5", "--seed", str(seed), "--quiet", "--inspect"]
    assert main([*argv, "--json", str(figures)]) == 0
    assert "report.html" in capsys.readouterr().out
    text = (tmp_path / "d" / "report.html").read_text()
    assert f"seed {seed}" in text and "slider (m)" in text
    assert len(json.loads(figures.read_text())["survey"]["columns"]) == 5


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        ("plot unicorn", "'unicorn'"),
        ("plot cartpole --case gorge", "unknown case 'gorge', expected one of passive"),
        ("plot cartpole --rows 1", "rows of at least 2, got 1"),
        ("plot cartpole --steps 0", "steps of at least 1, got 0"),
        ("data cube --from a.npz --inspect", "--inspect without --from"),
    ],
)
def test_bad_input_is_refused(argv, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(argv.split()) == 2
    said = capsys.readouterr().err
    assert words in said and said.count("\n") == 1
    assert not list(tmp_path.iterdir())
