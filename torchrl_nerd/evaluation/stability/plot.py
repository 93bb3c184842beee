"""Which cases a robot passes, and by how much."""

from pathlib import Path

from torchrl_nerd.evaluation.plots import COLORS, make_figure, save_figure
from torchrl_nerd.evaluation.stability.run import Result

LEAST, MOST = 1e-6, 1e6  # ratios beyond are clipped
BAR = 0.24  # inches
PASS, FAIL = COLORS[2], COLORS[1]


def plot_results(results: list[Result], path: Path, title: str) -> None:
    """Every metric that has a tolerance, relative to it; above one it fails.

    Args:
        results: from `run_cases`.
        path: a PNG.
        title: above it.
    """
    names, ratios = [], []
    for result in results:
        for metric, limit in result.tolerances.items():
            names.append(f"{result.case}: {metric}")
            value = result.tested[metric]
            ratio = value / limit if limit else (LEAST if value == 0 else MOST)
            ratios.append(min(max(ratio, LEAST), MOST))
    figure, (axes,) = make_figure(1, height=BAR * len(names) + 1.2)
    colors = [PASS if ratio <= 1.0 else FAIL for ratio in ratios]
    axes.barh(range(len(names)), [r - LEAST for r in ratios], left=LEAST, color=colors)
    axes.set_yticks(range(len(names)), names, fontsize=7)
    axes.invert_yaxis()
    axes.set_xscale("log")
    axes.axvline(1.0, color="black", linewidth=1)
    axes.set_xlim(LEAST, 10.0 * max(1.0, *ratios))
    axes.set_xlabel("metric relative to its tolerance (green: pass; smaller is better)")
    axes.set_title(title)
    save_figure(figure, path)
