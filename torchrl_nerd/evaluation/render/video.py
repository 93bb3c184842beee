"""Side-by-side rollouts as GIF or MP4 video, or as a PNG figure of frames."""

from collections.abc import Iterable, Iterator
from importlib.util import find_spec
from itertools import chain
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from torchrl_nerd.evaluation.render.renderer import RobotRenderer
from torchrl_nerd.evaluation.render.side_by_side import SideBySide
from torchrl_nerd.files import write_atomically

FRAMES_PER_SECOND = 25  # a GIF counts in hundredths of a second
FIGURE_FRAMES = 6
GIF_COLORS = 64
INK, GRAY = (30, 30, 30), (110, 110, 110)


def check_video(path: Path) -> None:
    """Check before any work that such a file can be written here.

    Raises:
        ValueError: another suffix than .gif, .mp4 or .png.
        ModuleNotFoundError: pillow or imageio-ffmpeg is not installed.
    """
    if path.suffix not in (".gif", ".mp4", ".png"):
        raise ValueError(f"expected a file named .gif, .mp4 or .png, got '{path}'")
    needed = "imageio_ffmpeg" if path.suffix == ".mp4" else "PIL"
    if find_spec(needed) is None:
        raise ModuleNotFoundError(
            "videos need pillow and imageio-ffmpeg: pip install 'torchrl-nerd[examples]'"
        )


def write_video(
    pair: SideBySide,
    path: Path,
    width: int = 720,
    slowdown: float = 1.0,
    quiet: bool = False,
) -> int:
    """Write a video by its suffix, whole or not at all, and return its number of frames.

    Args:
        pair: the two rollouts.
        path: .gif or .mp4, or .png for a figure of `FIGURE_FRAMES` frames.
        width: of a frame with both robots, pixels.
        slowdown: 2 plays at half speed.
        quiet: no progress bar.

    Raises:
        ValueError: see `check_video`, or no OpenGL library works on this machine.
        ModuleNotFoundError: pillow or imageio-ffmpeg is not installed.
    """
    check_video(path)
    from PIL import Image

    count = max(2, round(pair.seconds * slowdown * FRAMES_PER_SECOND) + 1)
    if path.suffix == ".png":
        count = FIGURE_FRAMES
    steps = torch.linspace(0, len(pair.paths[0]) - 1, count).round().long().tolist()
    bar = tqdm(steps, "video", unit=" frames", disable=quiet)
    frames = make_frames(pair, bar, width)

    def write(aside: Path) -> None:
        if path.suffix == ".png":
            Image.fromarray(np.vstack(list(frames))).save(aside, "PNG")
        elif path.suffix == ".gif":
            how = {"save_all": True, "duration": 1000 // FRAMES_PER_SECOND, "loop": 0}
            shown, plain = map(Image.fromarray, frames), Image.Dither.NONE
            images = (image.quantize(GIF_COLORS, dither=plain) for image in shown)
            next(images).save(aside, "GIF", append_images=images, **how)
        else:
            _write_mp4(frames, aside)

    write_atomically(path, write)
    return count


def _write_mp4(frames: Iterator[np.ndarray], path: Path) -> None:
    import imageio_ffmpeg

    first = next(frames)
    how = {"output_params": ["-f", "mp4"], "macro_block_size": 2}
    size = first.shape[1::-1]  # width, height
    writer = imageio_ffmpeg.write_frames(path, size, fps=FRAMES_PER_SECOND, **how)
    writer.send(None)  # starts ffmpeg
    for frame in chain([first], frames):
        writer.send(np.ascontiguousarray(frame))
    writer.close()


def make_frames(
    pair: SideBySide, steps: Iterable[int], width: int
) -> Iterator[np.ndarray]:
    """Frames ``(height, width, 3)``, uint8: both robots under their captions.

    Args:
        pair: the two rollouts.
        steps: which states to show.
        width: of a frame, pixels; rounded down to a multiple of 4.
    """
    side = width // 4 * 2
    renderer = RobotRenderer(pair.scene, side, side * 2 // 5 * 2, pair.terrain)
    try:
        for step in steps:
            sides = [
                (_caption(pair, i, step, side), renderer.render(path[step]))
                for i, path in enumerate(pair.paths)
            ]
            yield np.hstack([np.vstack(one) for one in sides])
    finally:
        renderer.close()


def _caption(pair: SideBySide, i: int, step: int, width: int) -> np.ndarray:
    """The strip over one image: name, then kind, time and return so far."""
    from PIL import Image, ImageDraw
    from PIL.ImageFont import load_default

    size = max(10, width // 16)
    strip = Image.new("RGB", (width, 5 * size // 4 * 2), "white")
    pen = ImageDraw.Draw(strip)
    pen.text((size // 2, size // 8), pair.names[i], INK, load_default(size))
    text = f"{pair.kinds[i]}, {pair.step_size * step:.2f} s"
    if pair.returns[i].any():
        text += f", return {float(pair.returns[i][step]):.0f}"
    pen.text((size // 2, 11 * size // 8), text, GRAY, load_default(0.85 * size))
    return np.asarray(strip)
