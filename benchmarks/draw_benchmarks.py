"""Draw error against speed from what `nerd bench SCENE --json` wrote.

    python benchmarks/draw_benchmarks.py

An SVG in docs/figures for every ``results/bench_*.json``.
"""

from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from string import ascii_lowercase
from typing import Any

import tyro
from equal_error import RESULTS, reports
from matplotlib.figure import Figure

from torchrl_nerd.evaluation.bench.report import BenchReport, pareto_front

FIGURES = RESULTS.parent / "docs" / "figures"
# The colors of Okabe and Ito are told apart by every eye: https://jfly.uni-koeln.de/color/
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")
MARKERS = {"simulator": "o", "analytic": "s", "hybrid": "D", "learned": "^"}
PANELS = 3  # most quantities that are drawn: of an arm, its first and its last joint


@dataclass
class Options:
    """Where the results are, and where the pictures go."""

    results: Path = RESULTS
    figures: Path = FIGURES


def plot_bench(report: BenchReport, path: Path, batch: int | None = None) -> None:
    """One panel per quantity, the Pareto front as a line.

    Args:
        report: of `bench`.
        path: of the picture.
        batch: trajectories stepped together; `BenchReport.batch` by default.
    """
    batch = batch or report.batch
    units = {row.quantity: row.unit for row in report.errors}
    shown = list(units) if len(units) <= PANELS else [list(units)[0], list(units)[-1]]
    figure = Figure(figsize=(8.5, 4.0 * len(shown)), layout="constrained")
    panels = figure.subplots(len(shown), 1, squeeze=False)[:, 0]
    kinds = {row.name: row.kind for row in report.rates}
    for axes, quantity in zip(panels, shown, strict=True):
        points = {
            name: point
            for name, point in report.points(batch, quantity).items()
            if isfinite(point[0]) and point[0] > 0.0  # a coarse step may diverge
        }
        for number, (kind, marker) in enumerate(MARKERS.items()):
            chosen = [p for name, p in points.items() if kinds[name] == kind]
            if chosen:
                xy = zip(*chosen, strict=True)
                axes.plot(*xy, marker, ls="", color=COLORS[number], label=kind)
        best = pareto_front(points)
        front = [points[name] for name in best]
        axes.plot(*zip(*front, strict=True), "-", color="0.4", label="Pareto front")
        models = [n for n in points if kinds[n] != "simulator" and n not in best]
        marks = dict(zip(best, map(str, range(1, 1 + len(best))), strict=True))
        marks |= dict(zip(models, ascii_lowercase, strict=False))
        for count, (name, mark) in enumerate(marks.items()):  # names would collide
            place = (5, 4) if count % 2 else (-9, -10)
            how: dict[str, Any] = {"textcoords": "offset points", "fontsize": 8}
            axes.annotate(mark, points[name], place, weight="bold", **how)
            axes.plot([], [], " ", label=f"{mark}: {name}")
        axes.margins(0.1)
        for row in report.errors:
            if row.quantity != quantity or row.kind not in ("sensitivity", "published"):
                continue
            style = ":" if row.kind == "sensitivity" else "--"
            axes.axvline(row.mean, ls=style, color="0.6", label=row.name)
        axes.set(
            title=f"{report.scene}: {quantity}",
            xscale="log",
            yscale="log",
            xlabel=f"mean error over {report.steps} steps ({units[quantity]})",
            ylabel=f"control steps/s, batch {batch}",
        )
        corner = {"xycoords": "axes fraction", "textcoords": "axes fraction"}
        arrow = {"arrowstyle": "->", "color": "0.3"}
        axes.annotate("better", (0.02, 0.97), (0.12, 0.87), **corner, arrowprops=arrow)
        axes.tick_params(which="minor", labelsize=7)  # larger ones cover each other
        axes.legend(frameon=False, fontsize=7, loc="upper left", bbox_to_anchor=(1, 1))
        axes.grid(alpha=0.3)
    figure.savefig(path, dpi=150)


def main(options: Options) -> list[Path]:
    """Draw them; returns where."""
    drawn = []
    for path, report in reports(options.results).items():
        drawn.append(options.figures / path.with_suffix(".svg").name)
        plot_bench(report, drawn[-1])
    return drawn


if __name__ == "__main__":
    print(*main(tyro.cli(Options, description=__doc__)), sep="\n")
