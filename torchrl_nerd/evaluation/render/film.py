"""A film of a pair, by whatever can draw on this machine."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import torch
from tqdm import tqdm

from torchrl_nerd.evaluation.render.camera import aim
from torchrl_nerd.evaluation.render.drawing import DrawingRenderer
from torchrl_nerd.evaluation.render.movie import (
    FRAMES_PER_SECOND,
    check_movie,
    write_movie,
)
from torchrl_nerd.evaluation.render.opengl import OpenGLRenderer, find_gl
from torchrl_nerd.evaluation.render.pair import Pair
from torchrl_nerd.evaluation.render.poser import Poser
from torchrl_nerd.evaluation.render.sheet import SIDE, Sheet

if TYPE_CHECKING:
    from PIL.Image import Image

Draw = Literal["auto", "opengl", "drawing"]


def film(
    pair: Pair,
    path: Path,
    title: str = "",
    slow: float = 1.0,
    draw: Draw = "auto",
    quiet: bool = False,
) -> str:
    """Write the film of a pair and say what drew it.

    Args:
        pair: what was played.
        path: GIF or MP4.
        title: for the upper right corner.
        slow: times slower than life.
        draw: MuJoCo on OpenGL, drawings by matplotlib, or OpenGL where it works.
        quiet: no progress bar.

    Raises:
        ValueError: see `check_movie`, or no OpenGL where it was asked for.
    """
    check_movie(path)
    renderer = make_renderer(pair, draw)
    try:
        write_movie(_pictures(pair, renderer, title, slow, quiet), path)
    finally:
        renderer.close()
    return renderer.name


def make_renderer(pair: Pair, draw: Draw = "auto") -> OpenGLRenderer | DrawingRenderer:
    """What draws, looking at the true motion; see `film`.

    Raises:
        ValueError: no OpenGL where it was asked for.
    """
    gl = None if draw == "drawing" else find_gl()
    if gl is None and draw == "opengl":
        raise ValueError(
            "expected OpenGL without a screen, but neither egl nor osmesa draws here: "
            "leave the choice to auto"
        )
    poser = Poser(pair.scene, pair.terrain)
    camera = aim(poser, pair.truth, pair.step_size, SIDE[0] / SIDE[1])
    if gl is None:
        return DrawingRenderer(poser, camera, SIDE)
    return OpenGLRenderer(poser, camera, SIDE, gl)


def shown_steps(pair: Pair, slow: float) -> list[int]:
    """Steps whose states the film shows, the nearest one at each of its moments."""
    frames = max(2, round(pair.seconds * slow * FRAMES_PER_SECOND) + 1)
    steps = torch.linspace(0, len(pair.truth) - 1, frames).round().long()
    return steps.tolist()


def _pictures(
    pair: Pair,
    renderer: OpenGLRenderer | DrawingRenderer,
    title: str,
    slow: float,
    quiet: bool,
) -> Iterator["Image"]:
    sheet = Sheet(pair, title)
    for step in tqdm(shown_steps(pair, slow), "film", unit=" pictures", disable=quiet):
        learned = renderer.frame(step, pair.learned[step], pair.truth[step])
        yield sheet.picture(step, learned, renderer.frame(step, pair.truth[step]))
