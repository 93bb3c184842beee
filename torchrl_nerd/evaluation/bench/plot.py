"""The race as a picture: error to the right, speed upwards, best at the upper left."""

from pathlib import Path

from torchrl_nerd.evaluation.bench.report import BenchReport
from torchrl_nerd.evaluation.plots import COLORS, make_figure, save_figure


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
        }
        for name, (error, rate) in points.items():
            color = COLORS[0] if name.startswith("MuJoCo") else COLORS[1]
            axes.plot(error, rate, "o", color=color)
            axes.annotate(
                name, (error, rate), (4, 4), textcoords="offset points", fontsize=7
            )
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
    save_figure(figure, path)
