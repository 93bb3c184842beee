"""Learned steps against MuJoCo's at equal error: the table of docs/performance.md.

    python benchmarks/equal_error.py

Of what `nerd bench SCENE --json docs/figures/bench_SCENE.json` wrote. MuJoCo's rate at the
error of a learned row lies on its own Pareto front, of all substeps and integrators of the
same race: between two rows of it on a straight line in the logarithms of error and rate,
beyond its fastest row at that row's.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from math import exp, inf, isfinite, log
from pathlib import Path

import tyro
from stability_table import FIGURES

from torchrl_nerd.evaluation.bench.pareto import pareto_front
from torchrl_nerd.evaluation.bench.report import BenchReport
from torchrl_nerd.files import read_json
from torchrl_nerd.robots import load_scene

WAY = ", compiled"  # how a model runs in this table, in float32
RATES = ("steps_per_s", "envs_per_s")
ROWS = 512  # the batch of most races

Point = tuple[float, float]
"""Error, and steps per second."""


@dataclass
class Options:
    """Where the figures are."""

    folder: Path = FIGURES


@dataclass(frozen=True)
class Ratio:
    """One model with one batch, its rate in MuJoCo's at its error.

    | field | meaning |
    |---|---|
    | ``scene``, ``model``, ``batch`` | of which race |
    | ``alone``, ``in_env`` | smallest and largest over the quantities that err |
    """

    scene: str
    model: str
    batch: int
    alone: tuple[float, float]
    in_env: tuple[float, float]


def rate_at(error: float, points: Mapping[str, Point]) -> float:
    """MuJoCo's rate at an error, 0 where none of its rows is so exact."""
    front = [points[name] for name in pareto_front(points)]
    below = [point for point in front if point[0] <= error]
    above = [point for point in front if point[0] > error]
    if not below:
        return 0.0
    if not above or below[-1][0] == error:
        return below[-1][1]
    (low, slow), (high, fast) = below[-1], above[0]
    share = log(error / low) / log(high / low)
    return exp((1.0 - share) * log(slow) + share * log(fast))


def ratios(report: BenchReport) -> Iterator[Ratio]:
    """Of every model of one race, batch by batch."""
    for batch in report.rates:
        for name in report.errors:
            if name.endswith(WAY):
                both = (spread(report, batch, name, kind) for kind in RATES)
                yield Ratio(report.scene, name.removesuffix(WAY), batch, *both)


def spread(
    report: BenchReport, batch: int, name: str, kind: str
) -> tuple[float, float]:
    """Smallest and largest ratio of a row's rate over the quantities that err."""
    rates = {row: getattr(rate, kind) for row, rate in report.rates[batch].items()}
    true = [row for row in report.errors if row.startswith("MuJoCo")]
    found = []
    for quantity, error in report.errors[name].items():
        points = {x: (report.errors[x][quantity].mean, rates[x]) for x in true}
        rival = rate_at(error.mean, points)
        found.append(rates[name] / rival if rival else inf)
    return min(found), max(found)


def table(found: list[Ratio]) -> str:
    """Markdown, smallest robots first."""
    scenes = {x.scene: load_scene(x.scene) for x in found}

    def order(x: Ratio) -> tuple:
        return scenes[x.scene].model.nv, x.scene, x.batch != ROWS, x.batch

    lines = [
        "| scene | dofs | contact points | substeps | model | rows | at equal error |"
        " in env and collector |",
        "|---" * 8 + "|",
    ]
    for x in sorted(found, key=order):
        scene = scenes[x.scene]
        sizes = scene.model.nv, len(scene.contacts), scene.substeps
        cells = (x.scene, *sizes, f"`{x.model}`", f"{x.batch:,}")
        shown = (*cells, written(x.alone), written(x.in_env))
        lines.append(f"| {' | '.join(map(str, shown))} |")
    return "\n".join(lines)


def written(spread: tuple[float, float]) -> str:
    """One figure, or two where quantities differ."""
    if not isfinite(spread[1]):
        return "no row of MuJoCo is so exact"
    low, high = (f"{x:.1f}" for x in spread)
    return low if low == high else f"{low} to {high}"


def races(folder: Path) -> dict[Path, BenchReport]:
    """Every race in the folder, by its file."""
    paths = sorted(folder.glob("bench_*.json"))
    return {path: BenchReport.from_figures(read_json(path)) for path in paths}


def read(folder: Path) -> list[Ratio]:
    """Of every race in the folder; of a model that ran in two, the later file's."""
    found = {}
    for report in races(folder).values():
        for ratio in ratios(report):
            found[ratio.scene, ratio.model, ratio.batch] = ratio
    return list(found.values())


def main(options: Options) -> None:
    """Print the table."""
    print(table(read(options.folder)))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
