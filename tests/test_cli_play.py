"""``nerd play``: a video, its results, and refusals in one sentence."""

import json

import pytest
from PIL import Image

from torchrl_nerd.cli import main
from torchrl_nerd.envs.rendering import find_gl
from torchrl_nerd.evaluation.policy import Policy, save_policy
from torchrl_nerd.files import read_json

has_gl = pytest.mark.skipif(
    find_gl() is None, reason="no OpenGL library works on this machine"
)


def test_the_help_says_that_a_file_is_a_task(capsys):
    with pytest.raises(SystemExit):
        main(["play", "--help"])
    said = " ".join(capsys.readouterr().out.split())
    assert "or an MJCF file" in said and "nerd play robot.xml" in said


@has_gl
@pytest.mark.parametrize("task", ["cartpole/swingup", "cube_slope/toss"])
def test_a_video_and_its_results(task, tmp_path, seed, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    argv = ["play", task, "--seed", str(seed), "--steps", "6", "--width", "100"]
    argv += ["--dynamics", "analytic"]
    assert main([*argv, "--quiet", "--json", "results.json"]) == 0
    out = f"runs/{task.replace('/', '-')}.gif"
    said = capsys.readouterr().out
    assert f"{out}: " in said and "analytic" in said and "ground truth" in said
    results = json.loads((tmp_path / "results.json").read_text())
    assert results["video"] == out and results["steps"] <= 6
    assert [one["dynamics"] for one in results["rollouts"]][1] == "MuJoCo"
    assert results["configuration"]["seed"] == seed
    with Image.open(tmp_path / out) as video:
        assert video.width == 100
        assert video.n_frames == int(25 * results["seconds"] + 1e-6) + 1


@has_gl
def test_a_policy_and_open_loop(tmp_path, seed):
    save_policy(Policy((4, 8, 1)), tmp_path / "policy")
    argv = ["play", "cartpole/swingup", "--policy", str(tmp_path / "policy")]
    argv += ["--steps", "4", "--seed", str(seed), "--width", "100", "--quiet"]
    out = tmp_path / "a.mp4"
    for extra in ([], ["--open-loop"]):
        assert main([*argv, *extra, "--out", str(out)]) == 0
        results = read_json(tmp_path / "a.mp4.json")  # without --json
        settings = results["configuration"]
        assert settings["open_loop"] == bool(extra)
        assert settings["policy"] == str(tmp_path / "policy")


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        ("fly/away", "unknown task 'fly/away'"),
        ("cartpole/swingup --out video.avi", ".gif or .mp4, got 'video.avi'"),
        ("cartpole/swingup --steps 0", "steps of at least 1, got 0"),
        ("cartpole/swingup --slowdown 0", "slowdown above 0, got 0.0"),
        ("cartpole/swingup --width 9", "width of at least 64, got 9"),
        ("cartpole/swingup --steps 2", "MUJOCO_GL"),
        ("cartpole/swingup --policy nowhere", "found no policy"),
        pytest.param(
            "cartpole/swingup --dynamics nowhere",
            "unknown dynamics 'nowhere'",
            marks=has_gl,
        ),
    ],
)
def test_bad_input_is_refused(argv, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    if words == "MUJOCO_GL":
        monkeypatch.setenv("MUJOCO_GL", "off")
    assert main(["play", *argv.split(), "--quiet"]) == 2
    said = capsys.readouterr().err
    assert words in said and said.startswith("nerd: ") and said.count("\n") == 1
    assert not list(tmp_path.iterdir())
