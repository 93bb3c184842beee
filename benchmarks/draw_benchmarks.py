"""Draw error against speed from what `nerd bench SCENE --json` wrote.

    python benchmarks/draw_benchmarks.py

A PNG in docs/figures for every ``results/bench_*.json``.
"""

from dataclasses import dataclass
from pathlib import Path

import tyro
from equal_error import RESULTS, reports

from torchrl_nerd.evaluation.bench.plot import plot_bench

FIGURES = RESULTS.parent / "docs" / "figures"


@dataclass
class Options:
    """Where the results are, and where the pictures go."""

    results: Path = RESULTS
    figures: Path = FIGURES


def main(options: Options) -> list[Path]:
    """Draw them; returns where."""
    drawn = []
    for path, report in reports(options.results).items():
        drawn.append(options.figures / path.with_suffix(".png").name)
        plot_bench(report, drawn[-1])
    return drawn


if __name__ == "__main__":
    print(*main(tyro.cli(Options, description=__doc__)), sep="\n")
