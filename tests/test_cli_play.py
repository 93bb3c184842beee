"""``nerd play``: a film, its figures, and refusals in one sentence."""

import json
import os

import pytest
import torch
from PIL import Image

from torchrl_nerd.cli import main
from torchrl_nerd.evaluation.policy import Policy, save_policy
from torchrl_nerd.evaluation.render.movie import write_movie
from torchrl_nerd.evaluation.render.sheet import SIZE
from torchrl_nerd.files import read_json


@pytest.fixture(autouse=True)
def no_screen(monkeypatch):
    """As on a server, and quick."""
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("MUJOCO_GL", "off")


@pytest.mark.parametrize("task", ["cartpole/swingup", "double_pendulum/passive"])
def test_a_film_and_its_figures(task, tmp_path, seed, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    argv = ["play", task, "--seed", str(seed), "--steps", "12", "--quiet"]
    assert main([*argv, "--json", "figures.json"]) == 0
    out = f"runs/{task.replace('/', '-')}.gif"
    said = capsys.readouterr().out
    assert f"{out}: " in said and "drawn by matplotlib" in said
    figures = json.loads((tmp_path / "figures.json").read_text())
    assert figures["film"] == out and figures["steps"] <= 12
    assert all(f["mean"] >= 0.0 and f["unit"] for f in figures["errors"].values())
    assert figures["configuration"]["seed"] == seed
    with Image.open(tmp_path / out) as film:
        assert film.size == SIZE and film.is_animated
        expected = round(figures["seconds"] * 25) + 1
        assert abs(film.n_frames - expected) <= 2  # a GIF merges equal pictures


def test_a_film_of_a_policy_in_slow_motion(tmp_path, seed):
    save_policy(Policy((4, 8, 1)), tmp_path / "policy")
    argv = ["play", "cartpole/swingup", "--policy", str(tmp_path / "policy")]
    argv += ["--steps", "6", "--seed", str(seed), "--own-actions", "--quiet"]
    lengths = []
    for slow in ("1", "4"):
        out = tmp_path / f"{slow}.gif"
        assert main([*argv, "--slow", slow, "--out", str(out)]) == 0
        with Image.open(out) as film:
            lengths.append(film.n_frames)
        how = read_json(tmp_path / f"{slow}.gif.json")[
            "configuration"
        ]  # without --json
        assert (how["slow"], how["policy"]) == (float(slow), str(tmp_path / "policy"))
    assert lengths[1] > 1.5 * lengths[0]


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        ("fly/away", "unknown task 'fly/away'"),
        ("cartpole/swingup --out film.avi", ".gif or .mp4, got 'film.avi'"),
        ("cartpole/swingup --steps 0", "steps of at least 1, got 0"),
        ("cartpole/swingup --slow 0", "slow above 0, got 0.0"),
        ("cartpole/swingup --viewer", "the viewer needs a display, found none"),
        ("cartpole/swingup --draw opengl --steps 2", "neither egl nor osmesa"),
        ("cartpole/swingup --policy nowhere", "found no policy"),
        ("cartpole/swingup --model nowhere", "unknown dynamics 'nowhere'"),
    ],
)
def test_bad_input_is_refused(argv, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["play", *argv.split(), "--quiet"]) == 2
    said = capsys.readouterr().err
    assert words in said and said.startswith("nerd: ") and said.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_mp4_without_ffmpeg_is_refused_before_any_work(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("PATH", "")
    monkeypatch.setattr(
        "sys.path", [x for x in os.sys.path if "site-packages" not in x]
    )
    assert main(["play", "cartpole/swingup", "--out", str(tmp_path / "a.mp4")]) == 2
    assert "MP4 needs ffmpeg" in capsys.readouterr().err


def test_a_film_keeps_its_pictures(tmp_path, generator):
    shades = torch.randperm(250, generator=generator)[:7].tolist()
    pictures = [Image.new("RGB", (16, 8), (shade, 0, 0)) for shade in shades]
    write_movie(iter(pictures), tmp_path / "a.gif")
    with Image.open(tmp_path / "a.gif") as film:
        assert film.n_frames == 7 and film.info["duration"] == 40
        for number, shade in enumerate(shades):
            film.seek(number)
            assert abs(film.convert("RGB").getpixel((8, 4))[0] - shade) < 16
