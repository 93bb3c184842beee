"""Which cases a robot passes, and by how much."""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from torchrl_nerd.evaluation.stability.run import Result
from torchrl_nerd.files import write_atomically

LEAST, MOST = 1e-6, 1e6  # shares of the line that are drawn as they are


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
    figure, axes = plt.subplots(figsize=(9, 0.32 * len(names) + 1.6))
    colours = ["#2a7f62" if share <= 1.0 else "#c0392b" for share in shares]
    axes.barh(range(len(names)), [s / LEAST for s in shares], left=LEAST, color=colours)
    axes.set_yticks(range(len(names)), names, fontsize=8)
    axes.invert_yaxis()
    axes.set_xscale("log")
    axes.axvline(1.0, color="black", linewidth=1)
    axes.set_xlim(LEAST, 10.0 * max(1.0, *shares))
    axes.set_xlabel("learned figure as a share of its line (green: kept)")
    axes.set_title(title)
    axes.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    write_atomically(path, lambda aside: figure.savefig(aside, format="png", dpi=120))
    plt.close(figure)
