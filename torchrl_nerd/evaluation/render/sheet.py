"""One picture of a film: both sides, their names, the time, and the error as it grows."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from torchrl_nerd.evaluation.plots import COLORS, need_matplotlib
from torchrl_nerd.evaluation.render.pair import Pair
from torchrl_nerd.evaluation.render.style import FAINT, INK
from torchrl_nerd.evaluation.rollout_error import unit_of

if TYPE_CHECKING:
    from PIL.Image import Image
    from PIL.ImageDraw import ImageDraw

SIDE = (480, 384)  # pixels: width and height of each side
GAP, HEAD, CHART = 4, 40, 150  # pixels
SIZE = (2 * SIDE[0] + GAP, HEAD + SIDE[1] + CHART)
DPI = 100
LEFT = 0.075  # of the width: where the chart begins
MOST_LINES = 3  # in the chart
SIDES = ("learned", "MuJoCo")


@dataclass(frozen=True)
class Line:
    """Error of one quantity over time."""

    name: str
    unit: str
    values: np.ndarray


def error_lines(pair: Pair) -> list[Line]:
    """What the chart shows: every quantity, or the mean of those of one unit.

    Means where there are more than `MOST_LINES`, such as the joints of an arm.
    """
    lines = [
        Line(name.replace("_", " "), unit_of(pair.scene, name), values.numpy())
        for name, values in pair.errors.items()
    ]
    if len(lines) <= MOST_LINES:
        return lines
    units = dict.fromkeys(line.unit for line in lines)
    return [
        Line(
            "mean of joints",
            unit,
            np.mean([x.values for x in lines if x.unit == unit], 0),
        )
        for unit in units
    ]


class Sheet:
    """Lays out the pictures of one pair.

    Args:
        pair: what was played.
        title: at the upper right.
    """

    def __init__(self, pair: Pair, title: str) -> None:
        need_matplotlib()
        self.pair, self.title, self.lines = pair, title, error_lines(pair)
        self._chart, self._cursor = self._draw_chart()

    def picture(self, step: int, learned: np.ndarray, truth: np.ndarray) -> "Image":
        """One picture, RGB of `SIZE`.

        Args:
            step: which.
            learned: ``(height, width, 3)`` of `SIDE`, uint8; of the learned side.
            truth: the same of the true one.
        """
        from PIL import Image, ImageDraw

        sheet = Image.new("RGB", SIZE, "white")
        for number, pixels in enumerate((learned, truth)):
            place = (number * (SIDE[0] + GAP), HEAD)
            sheet.paste(Image.fromarray(np.ascontiguousarray(pixels)), place)
        sheet.paste(self._chart, (0, HEAD + SIDE[1]))
        pen = ImageDraw.Draw(sheet)
        self._write_head(pen, step)
        self._write_errors(pen, step)
        x, top, bottom = self._cursor(step)
        y = HEAD + SIDE[1]
        pen.line((x, y + top, x, y + bottom), fill=FAINT, width=1)
        return sheet

    def _write_head(self, pen: "ImageDraw", step: int) -> None:
        from PIL.ImageFont import load_default

        large, small = load_default(20), load_default(15)
        for number, name in enumerate(SIDES):
            x = number * (SIDE[0] + GAP) + 14
            pen.text((x, HEAD // 2), name, INK, large, anchor="lm")
            if number == 0:
                x += pen.textlength(name, large) + 10
                pen.text(
                    (x, HEAD // 2 + 1), "MuJoCo in grey", FAINT, small, anchor="lm"
                )
        seconds = f"{self.pair.step_size * step:.2f} s"
        pen.text((SIZE[0] - 14, HEAD // 2), seconds, INK, large, anchor="rm")
        x = SIZE[0] - 14 - pen.textlength("00.00 s", large) - 12
        pen.text((x, HEAD // 2 + 1), self.title, FAINT, small, anchor="rm")

    def _write_errors(self, pen: "ImageDraw", step: int) -> None:
        from PIL.ImageFont import load_default

        font = load_default(15)
        x, y = LEFT * SIZE[0], HEAD + SIDE[1] + 16
        pen.text((14, y), "error", INK, font, anchor="lm")
        for color, line in zip(COLORS, self.lines, strict=False):
            pen.line((x, y, x + 22, y), fill=color, width=3)
            text = f"{line.name}  {line.values[step]:.2g} {line.unit}"
            pen.text((x + 30, y), text, INK, font, anchor="lm")
            x += 285

    def _draw_chart(self) -> "tuple[Image, Callable[[int], tuple[float, ...]]]":
        """The chart, and of a step the cursor's x, top and bottom in it, pixels."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
        from PIL import Image

        figure = Figure((SIZE[0] / DPI, CHART / DPI), dpi=DPI)
        canvas = FigureCanvasAgg(figure)
        axes = figure.add_axes((LEFT, 0.28, 0.98 - LEFT, 0.46))
        seconds = self.pair.step_size * np.arange(len(self.pair.truth))
        for color, line in zip(COLORS, self.lines, strict=False):
            axes.plot(seconds, line.values, color=color, lw=1.8)
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.3)
        axes.set_xlim(0.0, max(float(seconds[-1]), self.pair.step_size))
        axes.set_ylim(0.0, 1.1 * max(self._largest(), 1e-9))
        axes.tick_params(labelsize=8)
        axes.locator_params(axis="y", nbins=4)
        axes.set_xlabel("time (s)", fontsize=9, labelpad=1)
        canvas.draw()
        picture = Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())

        def cursor(step: int) -> tuple[float, ...]:
            ends = axes.transData.transform(
                [(seconds[step], y) for y in axes.get_ylim()]
            )
            return (
                float(ends[0, 0]),
                CHART - float(ends[1, 1]),
                CHART - float(ends[0, 1]),
            )

        return picture, cursor

    def _largest(self) -> float:
        values = torch.tensor(np.array([line.values for line in self.lines]))
        return (
            float(values[values.isfinite()].max()) if values.isfinite().any() else 1.0
        )
