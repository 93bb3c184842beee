"""Draw the races of docs/performance.md from what `nerd bench SCENE --json` wrote.

    python benchmarks/draw_races.py

A picture beside every race of 512 rows; of an arm, first and last joint.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import tyro
from equal_error import ROWS, races
from stability_table import FIGURES

from torchrl_nerd.evaluation.bench.plot import plot_race
from torchrl_nerd.evaluation.bench.report import BenchReport

MOST_PANELS = 3


@dataclass
class Options:
    """Where the figures are."""

    folder: Path = FIGURES


def with_ends(report: BenchReport) -> BenchReport:
    """The report, of many quantities its first and last one alone."""
    if len(report.quantities) <= MOST_PANELS:
        return report
    kept = {report.quantities[0], report.quantities[-1]}

    def part(rows: dict) -> dict:
        return {
            name: {q: e for q, e in errors.items() if q in kept}
            for name, errors in rows.items()
        }

    return replace(report, errors=part(report.errors), floors=part(report.floors))


def main(options: Options) -> list[Path]:
    """Draw them; returns where."""
    drawn = []
    for path, report in races(options.folder).items():
        if ROWS in report.rates:
            picture = path.with_suffix(".png")
            plot_race(with_ends(report), picture)
            drawn.append(picture)
    return drawn


if __name__ == "__main__":
    print(*main(tyro.cli(Options, description=__doc__)), sep="\n")
