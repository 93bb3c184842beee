"""Videos keep their frames; captions name the dynamics and their kind."""

from dataclasses import replace
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
import torch
from PIL import Image, ImageSequence

from torchrl_nerd.evaluation.render.renderer import find_gl
from torchrl_nerd.evaluation.render.side_by_side import SideBySide
from torchrl_nerd.evaluation.render.video import make_frames, write_video
from torchrl_nerd.robots import load_scene

WIDTH = 160


@pytest.fixture(scope="module")
def pair() -> SideBySide:
    """A cartpole that moves on the left and stands still on the right."""
    if find_gl() is None:
        pytest.skip("no OpenGL library works on this machine")
    still = torch.zeros(6, 2, dtype=torch.float64)
    moving = torch.linspace(0.0, 1.0, 6, dtype=torch.float64)[:, None] * still.new_ones(
        2
    )
    returns = (torch.zeros(6), torch.zeros(6))
    return SideBySide(
        scene=load_scene("cartpole"),
        step_size=0.04,
        names=("cartpole-mlp", "MuJoCo"),
        kinds=("learned", "ground truth"),
        paths=(moving, still),
        returns=returns,
        terrain=None,
        ending="steps",
    )


def test_frames_show_both_robots_under_their_captions(pair):
    first, last = (x.astype(int) for x in make_frames(pair, (0, 5), WIDTH))
    head = len(first) - WIDTH // 2 * 2 // 5 * 2  # height of the captions
    robots = abs(last - first)[head:].max(-1) > 30
    assert first.shape[1] == WIDTH
    assert robots[:, : WIDTH // 2].any() and not robots[:, WIDTH // 2 :].any()
    renamed = replace(pair, kinds=("hybrid", "ground truth"))
    (other,) = make_frames(renamed, (0,), WIDTH)
    caption = abs(other.astype(int) - first).max(-1) > 30
    assert caption[:head, : WIDTH // 2].any()
    assert not caption[:, WIDTH // 2 :].any() and not caption[head:].any()


def read(path: Path) -> np.ndarray:
    """Frames ``(count, height, width, 3)``."""
    if path.suffix == ".gif":
        frames = ImageSequence.Iterator(Image.open(path))
        return np.stack([np.asarray(frame.convert("RGB")) for frame in frames])
    frames = imageio_ffmpeg.read_frames(path)
    width, height = next(frames)["size"]
    shape = height, width, 3
    return np.stack([np.frombuffer(x, np.uint8).reshape(shape) for x in frames])


@pytest.mark.parametrize("suffix", [".gif", ".mp4"])
def test_a_video_has_its_frames_and_speed(pair, suffix, tmp_path):
    path = tmp_path / f"a{suffix}"
    counts = [
        write_video(pair, path, WIDTH, slowdown, quiet=True) for slowdown in (2.0, 1.0)
    ]
    assert counts == [11, 6]
    frames = read(path)
    assert len(frames) == 6 and frames.shape[2] == WIDTH
    expected = np.stack(list(make_frames(pair, range(6), WIDTH))).astype(int)
    assert abs(frames.astype(int) - expected).mean() < 4.0
    assert abs(frames[0].astype(int) - expected[5]).mean() > 0.5
    assert [x.name for x in tmp_path.iterdir()] == [path.name]
    if suffix == ".gif":
        assert Image.open(path).info["duration"] == 40


def test_a_figure_has_six_frames(pair, tmp_path):
    assert write_video(pair, tmp_path / "a.png", WIDTH, quiet=True) == 6
    figure = np.asarray(Image.open(tmp_path / "a.png"))
    frames = list(make_frames(pair, range(6), WIDTH))
    np.testing.assert_array_equal(figure, np.vstack(frames))
