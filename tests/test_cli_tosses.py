"""``nerd`` on recorded tosses: data, finetune, eval, and refusals in one sentence."""

import json

import numpy as np
import pytest
from helpers import EXCERPT

from torchrl_nerd.cli import main

TINY = [
    "--update",
    "all",
    "--epochs",
    "0.02",
    "--batch-size",
    "16",
    "--sequence-length",
    "2",
]


def refusal(capsys, *argv: str) -> str:
    status = main(list(argv))
    captured = capsys.readouterr()
    assert status == 2
    assert captured.err.startswith("nerd: ") and captured.err.count("\n") == 1
    return captured.err


@pytest.fixture
def half_widths(tmp_path):
    """The excerpt in the units it was published in."""
    with np.load(EXCERPT) as file:
        arrays = {name: file[name] for name in file.files}
    arrays["position"] = arrays["position"] / 0.0524
    np.savez(tmp_path / "wrong.npz", **arrays)
    return str(tmp_path / "wrong.npz")


@pytest.mark.parametrize("name", ["cube", "cube_real"])
def test_recorded_tosses_become_a_data_set(name, tmp_path, capsys):
    out, figures = tmp_path / "set", tmp_path / "figures.json"
    argv = ["data", name, "--from", str(EXCERPT), "--out", str(out)]
    assert main([*argv, "--json", str(figures)]) == 0
    assert "free fall along z" in capsys.readouterr().out
    assert json.loads(figures.read_text())["trajectories"] == 12
    assert (out / "data.json").exists()


def test_what_was_fine_tuned_is_measured(tmp_path, capsys):
    out, figures = tmp_path / "run", tmp_path / "figures.json"
    argv = ["finetune", "cube", "--from", str(EXCERPT), "--out", str(out), *TINY]
    assert main([*argv, "--scratch", "residual"]) == 0
    assert "epochs 0.02/0.02" in capsys.readouterr().err
    assert {p.name for p in out.iterdir()} == {
        "model.safetensors",
        "card.json",
        "curve.json",
    }
    argv = ["eval", "cube", "--data", str(EXCERPT), "--model", str(out)]
    assert main([*argv, "--json", str(figures)]) == 0
    content = json.loads(figures.read_text())
    for key in ("position_error_m", "orientation_error_rad"):
        assert {"mean", "final", "p95", "interval"} <= set(content[key])
        assert 0 < content[key]["mean"] < content[key]["p95"] < 3
    assert "ContactNets" in capsys.readouterr().out


def test_wrong_units_are_refused_with_check_and_figure(half_widths, tmp_path, capsys):
    for argv in (
        ["data", "cube", "--from", half_widths, "--out", str(tmp_path / "set")],
        ["eval", "cube", "--data", half_widths],
        ["finetune", "cube", "--from", half_widths, "--out", str(tmp_path / "run")],
    ):
        text = refusal(capsys, *argv)
        assert "free fall along z" in text and "-18" in text
    assert not (tmp_path / "set" / "data.json").exists()


def test_other_robots_and_splits_are_refused(tmp_path, capsys):
    out = str(tmp_path / "set")
    text = refusal(capsys, "data", "ant", "--from", str(EXCERPT), "--out", out)
    assert "'ant'" in text and "cube" in text
    assert "nowhere" in refusal(capsys, "eval", "cube", "--data", "nowhere.npz")
    argv = ["eval", "cube", "--data", str(EXCERPT), "--split", "best"]
    assert "'best'" in refusal(capsys, *argv)
