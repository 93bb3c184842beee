"""Pictures into a file that plays: GIF by pillow, MP4 by ffmpeg where there is one."""

import shutil
import subprocess
from collections.abc import Iterable
from contextlib import suppress
from importlib.util import find_spec
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

from torchrl_nerd.evaluation.plots import need_matplotlib
from torchrl_nerd.files import write_atomically

if TYPE_CHECKING:
    from PIL.Image import Image

FRAMES_PER_SECOND = 25  # a GIF counts in hundredths of a second
COLORS = 128  # of a GIF's picture


def check_movie(path: Path) -> None:
    """Say before any work whether such a file can be written here.

    Raises:
        ValueError: another ending than .gif or .mp4, or no ffmpeg for MP4.
    """
    if path.suffix not in (".gif", ".mp4"):
        raise ValueError(f"expected a file named .gif or .mp4, got '{path}'")
    if path.suffix == ".mp4" and find_ffmpeg() is None:
        raise ValueError(
            "MP4 needs ffmpeg, found neither the program nor the package "
            "imageio-ffmpeg: take a name ending in .gif"
        )


def find_ffmpeg() -> str | None:
    """The program ffmpeg: on the path, or the one that imageio-ffmpeg brings."""
    found = shutil.which("ffmpeg")
    if found is None and find_spec("imageio_ffmpeg") is not None:
        import imageio_ffmpeg  # pyright: ignore[reportMissingImports]

        found = imageio_ffmpeg.get_ffmpeg_exe()
    return found


def write_movie(pictures: Iterable["Image"], path: Path) -> None:
    """Write a film of `FRAMES_PER_SECOND`, whole or not at all.

    Args:
        pictures: RGB, all of one size with even sides.
        path: ending in .gif or .mp4.

    Raises:
        ValueError: see `check_movie`, or ffmpeg gave up.
    """
    need_matplotlib()
    check_movie(path)
    write = _write_gif if path.suffix == ".gif" else _write_mp4
    write_atomically(path, lambda aside: write(pictures, aside))


def _write_gif(pictures: Iterable["Image"], path: Path) -> None:
    from PIL.Image import Dither, Quantize

    def few_colors(picture: "Image") -> "Image":
        return picture.quantize(COLORS, Quantize.FASTOCTREE, dither=Dither.NONE)

    frames = map(few_colors, pictures)
    next(frames).save(
        path,
        format="GIF",
        save_all=True,
        append_images=frames,
        duration=1000 // FRAMES_PER_SECOND,
        loop=0,
    )


def _write_mp4(pictures: Iterable["Image"], path: Path) -> None:
    pictures = iter(pictures)
    first = next(pictures)
    size = f"{first.width}x{first.height}"
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size]
    source += ["-r", str(FRAMES_PER_SECOND), "-i", "-"]
    target = ["-c:v", "libx264", "-pix_fmt", "yuv420p", "-f", "mp4", str(path)]
    command = [str(find_ffmpeg()), "-y", "-loglevel", "error", *source, *target]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stderr=pipe) as process:
        assert process.stdin is not None and process.stderr is not None
        with suppress(BrokenPipeError):  # it gave up; what it says comes next
            for picture in chain([first], pictures):
                process.stdin.write(picture.tobytes())
            process.stdin.close()
        complaint = process.stderr.read().decode(errors="replace")
    if process.returncode:
        complaint = " ".join(complaint.split())
        raise ValueError(f"ffmpeg could not write {path.name}: {complaint}")
