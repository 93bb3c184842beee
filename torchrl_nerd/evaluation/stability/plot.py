"""Which cases a robot passes, and by how much."""

from pathlib import Path

from torchrl_nerd.evaluation.plots import COLORS, make_figure, save_figure
from torchrl_nerd.evaluation.stability.run import Result

LEAST, MOST = 1e-6, 1e6  # shares of the line that are drawn as they are
BAR = 0.24  # inches
KEPT, BROKEN = COLORS[2], COLORS[1]


def plot_results(results: list[Result], path: Path, title: str) -> None:
    """Every figure that has a line, as a share of it; right of one it is not kept.

    Args:
        results: from `run_cases`.
        path: a PNG.
        title: above it.
    """
    names, shares = [], []
    for result in results:
        for figure, line in result.lines.items():
            names.append(f"{result.case}: {figure}")
            value = result.learned[figure]
            share = value / line if line else (LEAST if value == 0 else MOST)
            shares.append(min(max(share, LEAST), MOST))
    figure, (axes,) = make_figure(1, height=BAR * len(names) + 1.2)
    colors = [KEPT if share <= 1.0 else BROKEN for share in shares]
    places = range(len(names))
    axes.barh(places, [s - LEAST for s in shares], left=LEAST, color=colors)
    axes.set_yticks(places, names, fontsize=7)
    axes.invert_yaxis()
    axes.set_xscale("log")
    axes.axvline(1.0, color="black", linewidth=1)
    axes.set_xlim(LEAST, 10.0 * max(1.0, *shares))
    axes.set_xlabel("learned figure as a share of its line (green: kept)")
    axes.set_title(title)
    save_figure(figure, path)
