"""The race as a picture: error to the right, speed upwards, best at the upper left."""

from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING

from torchrl_nerd.evaluation.bench.report import BenchReport
from torchrl_nerd.evaluation.plots import COLORS, make_figure, save_figure

if TYPE_CHECKING:  # matplotlib is an extra
    from matplotlib.axes import Axes
    from matplotlib.transforms import Bbox

MOST_SHIFT = 14  # points that a name may stand lower than its row


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
        best = report.front(batch, quantity)
        front = [points[name] for name in best]
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
        axes.tick_params(which="minor", labelsize=7)  # larger ones cover each other
        axes.legend(frameon=False, fontsize=7)
        _write_names(axes, points, best)
    save_figure(figure, path)


def _write_names(
    axes: "Axes", points: dict[str, tuple[float, float]], first: list[str]
) -> None:
    """Names beside their points, a little lower where they would cover each other.

    Where there is no room that a name has none; the table has it.
    """
    written: list[Bbox] = []
    others = sorted(points.keys() - set(first), key=lambda name: -points[name][1])
    for name in [*first, *others]:
        text = axes.annotate(
            name, points[name], (6, -3), textcoords="offset points", fontsize=7
        )
        for _ in range(MOST_SHIFT):
            if not any(text.get_window_extent().overlaps(other) for other in written):
                break
            x, y = text.get_position()
            text.set_position((x, y - 1))
        else:
            text.remove()
            continue
        written.append(text.get_window_extent())
