"""``nerd`` on recorded logs: data, finetune, eval, and refusals in one sentence."""

import json
from pathlib import Path

import numpy as np
import pytest
from helpers import EXCERPT, simulated, slow_but
from torch import Generator

from torchrl_nerd import load_scene
from torchrl_nerd.checkpoint import make_card, save_checkpoint
from torchrl_nerd.cli import main
from torchrl_nerd.configs import NO_PREDICTIONS
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.modules.networks import network_config
from torchrl_nerd.robots import cartpole

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
def test_recorded_logs_become_a_data_set(name, tmp_path, capsys):
    out, results = tmp_path / "set", tmp_path / "results.json"
    argv = ["data", name, "--from", str(EXCERPT), "--out", str(out)]
    assert main([*argv, "--json", str(results)]) == 0
    assert "free fall along z" in capsys.readouterr().out
    assert json.loads(results.read_text())["trajectories"] == 12
    assert (out / "data.json").exists()


@pytest.fixture
def network(real_cube, tmp_path):
    """Folder of a network with fresh weights."""
    model = NeRD(real_cube, NO_PREDICTIONS, network_config("mlp-4x64"))
    return str(save_checkpoint(model, tmp_path / "network", make_card(model)))


@pytest.mark.parametrize("update", slow_but(["all"], ["physics", "all"]))
def test_what_was_fine_tuned_is_measured(update, network, tmp_path, capsys):
    out, results = tmp_path / "run", tmp_path / "results.json"
    argv = ["finetune", "cube", "--from", str(EXCERPT), "--out", str(out)]
    how = ["--evaluations", "1"]
    if update == "all":
        how = ["--model", network, *TINY]
    assert main([*argv, *how]) == 0
    assert update == "physics" or "epochs 0.02/0.02" in capsys.readouterr().err
    assert {p.name for p in out.iterdir()} == {
        "model.safetensors",
        "card.json",
        "curve.json",
    }
    card = json.loads((out / "card.json").read_text())["finetuning"]
    assert {"converged_epoch", "converged_seconds", "start", "device"} <= set(card)
    assert card["update"] == update and card["validation_position_m"] > 0
    assert ("parameters" in card) == (update == "physics")
    argv = ["eval", "cube", "--data", str(EXCERPT), "--model", str(out)]
    assert main([*argv, "--json", str(results), "--baselines"]) == 0
    content = json.loads(results.read_text())
    assert {"scene", "split", "windows", "against", "others"} <= set(content)
    assert {"no motion", "MuJoCo", "model"} <= set(content["others"])
    for key in ("position_error_m", "orientation_error_rad"):
        names = {"mean", "final", "median", "p95", "interval", "first"}
        assert names == set(content[key])
        assert 0 < content[key]["mean"] < content[key]["p95"]
    assert "ContactNets" in capsys.readouterr().out


def write_cartpole_log(path: Path, generator: Generator, trajectories: int) -> None:
    """Trajectories of 12 states each, under random forces."""
    log = simulated(load_scene("cartpole"), generator, trajectories, states=12)
    names = ("qpos", "qvel", "joint_torque")
    arrays = {name: getattr(log, name).numpy() for name in names}
    np.savez(path, trajectory_offsets=log.offsets, **arrays)


def test_any_robots_log_goes_through_all_commands(generator, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_cartpole_log(Path("log.npz"), generator, trajectories=12)
    assert main("data cartpole --from log.npz --out set".split()) == 0
    argv = "finetune cartpole --from log.npz --out run --states 10".split()
    assert main([*argv, *TINY]) == 0
    argv = "eval cartpole --data log.npz --states 10 --model run --json f.json"
    assert main(argv.split()) == 0
    content = json.loads(open("f.json").read())
    assert content["scene"] == "cartpole" and content["windows"] == 12 * 3
    errors = {key for key in content if "_error_" in key}
    assert len(errors) == 2 and errors == set(content["others"]["model"])


def test_wrong_units_are_refused_with_check_and_figure(half_widths, tmp_path, capsys):
    for argv in (
        ["data", "cube", "--from", half_widths, "--out", str(tmp_path / "set")],
        ["eval", "cube", "--data", half_widths],
        ["finetune", "cube", "--from", half_widths, "--out", str(tmp_path / "run")],
    ):
        text = refusal(capsys, *argv)
        assert "free fall along z" in text and "-18" in text
    assert not (tmp_path / "set" / "data.json").exists()


def test_other_robots_and_splits_are_refused(network, tmp_path, capsys):
    out = str(tmp_path / "set")
    text = refusal(capsys, "data", "ant", "--from", str(EXCERPT), "--out", out)
    assert "expected 'qpos'" in text and "position" in text
    assert "nowhere" in refusal(capsys, "eval", "cube", "--data", "nowhere.npz")
    for states, is_published in (("80", True), ("10", False)):
        argv = ["eval", "cube", "--data", str(EXCERPT), "--states", states]
        assert main(argv) == 0
        assert ("paper" in capsys.readouterr().out) == is_published
    argv = ["eval", "cube", "--data", str(EXCERPT), "--split", "best"]
    assert "'best'" in refusal(capsys, *argv)
    argv = ["finetune", "cube", "--from", str(EXCERPT), "--out", out]
    argv += ["--model", network, "--update", "physics"]
    assert "analytic" in refusal(capsys, *argv)


@pytest.mark.parametrize("dry", [[], ["--dry-run"]])
def test_a_log_too_short_to_split_is_refused(dry, generator, tmp_path, capsys):
    write_cartpole_log(log := tmp_path / "log.npz", generator, trajectories=2)
    out = str(tmp_path / "run")
    argv = ["finetune", "cartpole", "--from", str(log), "--states", "10", "--out", out]
    argv += [*TINY, *dry, "--model", "cartpole-mlp"]
    assert "got a log of 2 with none for validation" in refusal(capsys, *argv)


def test_training_on_recorded_trajectories_is_told_of_finetune(
    generator, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    write_cartpole_log(Path("log.npz"), generator, trajectories=6)
    assert main("data cartpole --from log.npz --out set".split()) == 0
    capsys.readouterr()
    for more in ([], ["--vary", "preset"]):
        text = refusal(capsys, *"train cartpole --data set --quiet".split(), *more)
        assert text == (
            "nerd: expected simulated trajectories in set, got recorded ones, which "
            "`nerd finetune --from log.npz` learns from\n"
        )


def test_a_fine_tuned_model_is_not_written_over(generator, tmp_path, capsys):
    write_cartpole_log(log := tmp_path / "log.npz", generator, trajectories=12)
    out = tmp_path / "run"
    argv = ["finetune", "cartpole", "--from", str(log), "--states", "10", *TINY]
    argv += ["--out", str(out), "--model", "cartpole-mlp"]
    assert main(argv) == 0
    before = (out / "model.safetensors").read_bytes()
    capsys.readouterr()  # its progress bar
    assert "already holds a model: choose another --out" in refusal(capsys, *argv)
    assert (out / "model.safetensors").read_bytes() == before


def test_settings_that_cannot_be_are_refused(generator, tmp_path, capsys):
    write_cartpole_log(log := tmp_path / "log.npz", generator, trajectories=12)
    argv = ["eval", "cartpole", "--data", str(log), "--states", "1"]
    assert "expected states of at least 2, got 1" in refusal(capsys, *argv)
    argv = ["finetune", "cartpole", "--from", str(log), "--epochs", "inf"]
    assert "expected epochs of at least 0, got inf" in refusal(capsys, *argv)


def test_a_robot_of_a_file_stays_in_the_folder_of_data_sets(
    generator, tmp_path, monkeypatch
):
    source = Path(cartpole.__file__).with_name("cartpole.xml").read_text()
    (tmp_path / "robots").mkdir()
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    Path("../robots/cart.xml").write_text(source)
    scene = load_scene("../robots/cart.xml")
    log = simulated(scene, generator, 12, states=12)
    np.savez("log.npz", qpos=log.qpos, qvel=log.qvel, trajectory_offsets=log.offsets)
    assert main("data ../robots/cart.xml --from log.npz".split()) == 0
    assert [p.name for p in Path("datasets").iterdir()] == ["robots-cart_recorded"]
