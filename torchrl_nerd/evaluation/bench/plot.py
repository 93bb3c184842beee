"""The race as a picture: error to the right, speed upwards, best at the upper left."""

from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING

from torchrl_nerd.evaluation.bench.report import BenchReport
from torchrl_nerd.evaluation.plots import COLORS, make_figure, save_figure

if TYPE_CHECKING:  # matplotlib is an extra
    from matplotlib.axes import Axes
    from matplotlib.transforms import Bbox


def plot_race(report: BenchReport, path: Path, batch: int | None = None) -> None:
    """One panel per quantity, the Pareto front as a line.

    Args:
        report: of `bench`.
        path: of the PNG.
        batch: rows stepped together; 512 or the largest there is by default.
    """
    batches = list(report.rates)
    batch = batch or (512 if 512 in batches else max(batches))
    figure, panels = make_figure(
        len(report.quantities), height=4.0 * len(report.quantities), share_x=False
    )
    for axes, quantity in zip(panels, report.quantities, strict=True):
        points = {
            name: (errors[quantity].mean, report.rates[batch][name].steps_per_s)
            for name, errors in report.errors.items()
            if isfinite(errors[quantity].mean)  # a coarse step may blow up
        }
        for name, point in points.items():
            color = COLORS[0] if name.startswith("MuJoCo") else COLORS[1]
            axes.plot(*point, "o", color=color)
        front = [points[name] for name in report.front(batch, quantity)]
        axes.plot(*zip(*front, strict=True), "-", color=COLORS[2], label="Pareto front")
        for number, (name, errors) in enumerate(report.floors.items()):
            style = (":", "-.", "--")[number % 3]
            axes.axvline(errors[quantity].mean, ls=style, color="0.6", label=name)
        if quantity in report.published:
            axes.axvline(report.published[quantity], color=COLORS[3], label="the paper")
        unit = next(iter(report.errors.values()))[quantity].unit
        axes.set(
            xscale="log",
            yscale="log",
            xlabel=f"{quantity}, mean error over {report.steps} steps ({unit})",
            ylabel=f"control steps per second, {batch} rows",
        )
        axes.legend(frameon=False, fontsize=7)
        _write_names(axes, points)
    save_figure(figure, path)


def _write_names(axes: "Axes", points: dict[str, tuple[float, float]]) -> None:
    """Names beside their points, lower where they would cover each other."""
    written: list[Bbox] = []
    for name, point in sorted(points.items(), key=lambda item: -item[1][1]):
        text = axes.annotate(
            name, point, (6, -3), textcoords="offset points", fontsize=7
        )
        while any(text.get_window_extent().overlaps(other) for other in written):
            x, y = text.get_position()
            text.set_position((x, y - 1))
        written.append(text.get_window_extent())
