"""Ratios to the base as bars."""

from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure

from .table import Row

LESS, MORE = "#0072B2", "#D55E00"  # of error than the base
INCHES = 0.22  # per bar


def plot_ratios(rows: Sequence[Row], path: Path) -> None:
    """One panel for each test, one bar for each variant, to the right if it has more error.

    Args:
        rows: of one scene, the base first.
        path: of the PNG.
    """
    cases, variants = list(rows[0].errors), rows[1:]
    height = len(cases) * (1.0 + INCHES * len(variants))
    figure = Figure(figsize=(7.0, height), layout="constrained")
    panels = figure.subplots(len(cases), 1, squeeze=False)[:, 0]
    names = [row.name for row in variants]
    for axes, case in zip(panels, cases, strict=True):
        ratios = [row.ratio(case) for row in variants]
        colors = [MORE if ratio > 1.0 else LESS for ratio in ratios]
        shifts = [ratio - 1.0 for ratio in ratios]
        axes.barh(names, shifts, left=1.0, color=colors)
        for name, ratio in zip(names, ratios, strict=True):
            side = 3 if ratio > 1.0 else -3
            axes.annotate(
                f"{ratio:.2f}",
                (ratio, name),
                (side, 0),
                textcoords="offset points",
                ha="left" if ratio > 1.0 else "right",
                va="center",
                fontsize=7,
            )
        axes.axvline(1.0, color="0.3")
        axes.set_axisbelow(True)
        axes.invert_yaxis()
        axes.margins(x=0.12)
        axes.set(xscale="log", xlabel=f"{case}: mean error in the base's")
        for formatter in (
            axes.xaxis.set_major_formatter,
            axes.xaxis.set_minor_formatter,
        ):
            formatter("{x:g}")
        axes.tick_params(which="both", labelsize=8)
    figure.savefig(path, dpi=150)
