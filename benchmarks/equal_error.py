"""Speed of models against MuJoCo's at equal error, as a Markdown table.

    python benchmarks/equal_error.py

Of what `nerd bench SCENE --json results/bench_SCENE.json` wrote. MuJoCo's rate at the error
of a model lies on MuJoCo's own Pareto front, of all substeps and integrators of the same
benchmark: between two of its points on a straight line in the logarithms of error and
rate, beyond its fastest point at that point's rate.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from math import exp, inf, isfinite, log
from pathlib import Path

import tyro

from torchrl_nerd.evaluation.bench.report import BenchReport, pareto_front
from torchrl_nerd.evaluation.results import read_results
from torchrl_nerd.robots import load_scene

RESULTS = Path(__file__).parents[1] / "results"
VARIANT = ", compiled"  # how a model runs in this table, in float32
RATES = ("steps_per_s", "env_steps_per_s")

Point = tuple[float, float]
"""Error, and steps per second."""


@dataclass
class Options:
    """Where the results are."""

    folder: Path = RESULTS


@dataclass(frozen=True)
class Ratio:
    """One model with one batch, its rate over MuJoCo's at its error.

    | field | meaning |
    |---|---|
    | ``scene``, ``model``, ``kind``, ``batch`` | of which benchmark |
    | ``alone``, ``in_env`` | smallest and largest over the quantities |
    """

    scene: str
    model: str
    kind: str
    batch: int
    alone: tuple[float, float]
    in_env: tuple[float, float]


def rate_at(error: float, points: Mapping[str, Point]) -> float:
    """MuJoCo's rate at an error, 0 where none of its points is so accurate."""
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
    """Of every model of one benchmark, batch by batch."""
    for row in report.rates:
        if row.name.endswith(VARIANT):
            name = row.name.removesuffix(VARIANT)
            both = (spread(report, row.batch, row.name, rate) for rate in RATES)
            yield Ratio(report.scene, name, row.kind, row.batch, *both)


def spread(
    report: BenchReport, batch: int, name: str, rate: str
) -> tuple[float, float]:
    """Smallest and largest ratio of a model's rate over the quantities."""
    chosen = [row for row in report.rates if row.batch == batch]
    rates = {row.name: getattr(row, rate) for row in chosen}
    simulators = {row.name for row in chosen if row.kind == "simulator"}
    found = []
    for error in report.errors:
        if error.name != name:
            continue
        points = {
            row.name: (row.mean, rates[row.name])
            for row in report.errors
            if row.name in simulators and row.quantity == error.quantity
        }
        rival = rate_at(error.mean, points)
        found.append(rates[name] / rival if rival else inf)
    return min(found), max(found)


def table(found: list[Ratio]) -> str:
    """Markdown, smallest robots first."""
    scenes = {x.scene: load_scene(x.scene) for x in found}

    def order(x: Ratio) -> tuple:
        return scenes[x.scene].model.nv, x.scene, x.batch

    lines = [
        "| scene | dofs | contact points | substeps | model | kind | batch |"
        " at equal error | in env |",
        "|---" * 9 + "|",
    ]
    for x in sorted(found, key=order):
        scene = scenes[x.scene]
        sizes = scene.model.nv, len(scene.contacts), scene.substeps
        cells = (x.scene, *sizes, f"`{x.model}`", x.kind, f"{x.batch:,}")
        shown = (*cells, written(x.alone), written(x.in_env))
        lines.append(f"| {' | '.join(map(str, shown))} |")
    return "\n".join(lines)


def written(spread: tuple[float, float]) -> str:
    """One number, or two where quantities differ."""
    if not isfinite(spread[1]):
        return "MuJoCo is never so accurate"
    low, high = (f"{x:.1f}" for x in spread)
    return low if low == high else f"{low} to {high}"


def reports(folder: Path) -> dict[Path, BenchReport]:
    """Every benchmark in the folder, by its file."""
    paths = sorted(folder.glob("bench_*.json"))
    return {p: BenchReport.from_results(read_results(p)["results"]) for p in paths}


def read(folder: Path) -> list[Ratio]:
    """Of every benchmark in the folder; of a model that is in two, the later file's."""
    found = {}
    for report in reports(folder).values():
        for ratio in ratios(report):
            found[ratio.scene, ratio.model, ratio.batch] = ratio
    return list(found.values())


def main(options: Options) -> None:
    """Print the table."""
    print(table(read(options.folder)))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
