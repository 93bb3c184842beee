"""`make gpu` without a GPU: every stage's code on the CPU, at tiny sizes."""

import importlib
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest
import torch
from dynamics_helpers import double_model
from gpu import mjx_rates, wheels
from gpu.__main__ import ROOT, STAGES, main, run_apart
from gpu.graphs import InPlaceEnv, half
from gpu.stages import Setup, run_items
from helpers import slow_but
from tensordict import TensorDict

from torchrl_nerd import NeRDEnv, load_scene
from torchrl_nerd.dynamics import NeRDDynamics
from torchrl_nerd.evaluation.results import read_results

OPTIONAL = "dm_control dm_env gymnasium tyro pytorch_kinematics matplotlib imageio jax"
OPTIONAL += " mujoco_warp warp tensorboard glfw OpenGL"
ALONE = """
import sys
for name in sys.argv[1].split():
    sys.modules[name] = None
from torchrl_nerd import make_env
import torchrl_nerd.training.trainer
env = make_env("ant/run", num_envs=2)
print(env.rollout(2, break_when_any_done=False)["next", "qpos"].shape)
"""


def tiny(folder: Path) -> Setup:
    return Setup(torch.device("cpu"), is_tiny=True, folder=folder / "runs")


def test_a_learned_env_needs_no_optional_package():
    words = [sys.executable, "-W", "ignore", "-c", ALONE, OPTIONAL]
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.stdout == "torch.Size([2, 2, 15])\n", done.stderr


@pytest.mark.parametrize("letter", slow_but(set(STAGES) - {"b", "d"}, STAGES))
def test_every_stage_runs(letter, tmp_path):
    """Every item, without an error; a second run measures nothing again."""
    if letter == "c" and not mjx_rates.is_installed():
        pytest.skip("JAX or MJX is not installed")
    stage, setup = STAGES[letter], tiny(tmp_path)
    items = importlib.import_module(f"gpu.{stage.module}").items(setup)
    path = tmp_path / "stage.json"
    results = run_items(items, path, setup, 600.0, "make gpu")
    assert list(results["items"]) == list(items) and results["items"]
    errors = {k: x["error"] for k, x in results["items"].items() if "error" in x}
    assert not errors and not results["not_measured"]
    for name, found in results["items"].items():
        for key in ("per_s", "steps_per_s", "updates_per_s", "frames_per_s", "step_ms"):
            assert found.get(key, 1.0) > 0.0, name

    def fail() -> dict:
        raise AssertionError("measured twice")

    run_items(dict.fromkeys(items, fail), path, setup, 600.0, "make gpu")
    assert read_results(path)["results"] == results


def test_a_failure_and_the_end_of_the_time_are_said(tmp_path):
    def wait() -> dict:
        while True:
            pass

    def fail() -> dict:
        raise ValueError("no such thing")

    items = {"works": lambda: {"per_s": 1.0}, "fails": fail, "waits": wait}
    items["comes too late"] = lambda: {"per_s": 2.0}
    path, setup = tmp_path / "x.json", tiny(tmp_path)
    results = run_items(items, path, setup, 0.3, "make gpu")
    assert results["not_measured"] == ["fails", "waits", "comes too late"]
    assert results["items"]["fails"]["error"] == "ValueError: no such thing"
    assert results["items"]["waits"]["error"].startswith("out of time")
    items |= {"fails": lambda: {"per_s": 3.0}, "waits": lambda: {"per_s": 4.0}}
    again = run_items(items, path, setup, 60.0, "make gpu")
    assert again["not_measured"] == []
    assert again["items"]["works"] == results["items"]["works"]


def test_a_dry_run_lists_stages_sizes_and_what_is_missing(capsys, tmp_path):
    assert main(["--dry-run"]) == 0
    said = capsys.readouterr().out
    assert all(stage.about in said for stage in STAGES.values())
    assert all(name in said for name in wheels.WHEELS)
    if not torch.cuda.is_available():
        assert "device 'cuda'" in said
        assert main(["--out", str(tmp_path)]) == 2
        assert not list(tmp_path.iterdir())
    assert sum(stage.seconds for stage in STAGES.values()) < 7.5 * 60  # and starts
    assert sum(wheels.WHEELS.values()) < 50.0


def test_one_stage_alone(capsys, tmp_path):
    words = ["--device", "cpu", "--tiny", "--only", "f", "--out", str(tmp_path)]
    assert main(words) == 0
    assert [x.name for x in tmp_path.glob("*.json")] == ["f_profiles.json"]


@pytest.mark.slow
def test_a_stage_that_dies_takes_no_other_with_it(capfd, monkeypatch, tmp_path):
    """As a GPU's fault would end it; each stage is a process of its own."""
    monkeypatch.setenv("PYTHONPATH", f"{ROOT}:{ROOT / 'benchmarks'}")
    words = ["--device", "cpu", "--tiny", "--out", str(tmp_path)]
    run_apart("f", [*words, "--seed", "no number"], 60.0)
    run_apart("f", words, -19.9)
    run_apart("f", words, 60.0)
    said = capfd.readouterr().out
    assert "f: ended with code 2" in said and "f: was ended after its time" in said
    assert [x.name for x in tmp_path.glob("*.json")] == ["f_profiles.json"]


def test_wheels_are_those_of_the_tested_versions():
    constraints = ROOT / "constraints.txt"
    for package in ("mujoco", "torchrl", "tensordict"):
        assert wheels.pinned(package, constraints) == f"{package}=={version(package)}"
    engine = wheels.pinned("mujoco", constraints).split("==")[1]
    assert wheels.pinned("mujoco-mjx", constraints) == f"mujoco-mjx=={engine}"


def test_a_step_in_place_is_the_envs_own(generator):
    """With resets at the ends of episodes, all memory where it was."""
    model = double_model(load_scene("cartpole"), generator)
    envs = [NeRDEnv("cartpole/swingup", model, 4, seed=3) for _ in range(2)]
    for env in envs:
        env.task.horizon = 3
        env.reset()
    action = 2.0 * torch.rand(4, 1, generator=generator) - 1.0
    step = InPlaceEnv(envs[0], action)
    places = [x.data_ptr() for x in (*step.state.values(), step.age, step.observation)]
    now = TensorDict({"action": action}, [4])
    for _ in range(8):
        step()
        _, after = envs[1].step_and_maybe_reset(now.clone())
        for key, value in step.state.items():
            torch.testing.assert_close(value, after[key], rtol=0.0, atol=0.0)
        assert torch.equal(step.observation, after["observation"])
    now_at = [x.data_ptr() for x in (*step.state.values(), step.age, step.observation)]
    assert now_at == places and step.episode.min() > 1


@pytest.mark.parametrize("network", ["transformer-2x64", "mlp-2x32", "gru"])
def test_bf16_inside_is_near_and_leaves_the_model_alone(network, generator):
    from dynamics_helpers import random_drive, random_model, roll

    scene = load_scene("cartpole")
    model = random_model(scene, generator, network)
    before = {k: v.clone() for k, v in model.state_dict().items()}
    start, torque, terrain = random_drive(scene, 5, 4, generator)
    paths = [
        roll(dynamics, start, torque, terrain)["qvel"]
        for dynamics in (NeRDDynamics(model), half(model))
    ]
    apart = (paths[0] - paths[1]).abs().max() / paths[0].abs().max()
    assert 0.0 < apart < 0.1
    assert all(torch.equal(model.state_dict()[k], v) for k, v in before.items())
