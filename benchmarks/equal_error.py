"""Speed of models against MuJoCo's at equal error, as a Markdown table.

    python benchmarks/equal_error.py

Of what `nerd bench SCENE --json results/bench_SCENE.json` wrote. MuJoCo's rate at the error
of a model lies on MuJoCo's own Pareto front, of all substeps and integrators of the same
benchmark: between two of its points on a straight line in the logarithms of error and
rate, beyond its fastest point at that point's rate.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from math import exp, inf, isfinite, isnan, log, nan
from pathlib import Path

import tyro

from torchrl_nerd.evaluation.bench.errors import ErrorRow
from torchrl_nerd.evaluation.bench.rates import RateRow
from torchrl_nerd.evaluation.bench.report import BenchReport, pareto_front
from torchrl_nerd.evaluation.results import read_results
from torchrl_nerd.robots import load_scene

RESULTS = Path(__file__).parents[1] / "results"
VARIANT = ", compiled"  # how a model runs in this table, in float32

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
    | ``low``, ``high`` | smallest and largest ratio over the quantities; NaN: it diverges |
    """

    scene: str
    model: str
    kind: str
    batch: int
    low: float
    high: float


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
            found = []
            for error in report.errors:
                if error.name == row.name:
                    simulators = _simulators(report, row.batch, error.quantity)
                    rival = rate_at(error.mean, simulators)
                    ratio = row.steps_per_s / rival if rival else inf
                    found.append(ratio if isfinite(error.mean) else nan)
            name = row.name.removesuffix(VARIANT)
            both = (nan, nan) if any(map(isnan, found)) else (min(found), max(found))
            yield Ratio(report.scene, name, row.kind, row.batch, *both)


def _simulators(report: BenchReport, batch: int, quantity: str) -> dict[str, Point]:
    kinds = {row.name: row.kind for row in report.rates}
    points = report.points(batch, quantity)
    return {name: p for name, p in points.items() if kinds[name] == "simulator"}


def table(found: list[Ratio]) -> str:
    """Markdown, smallest robots first."""
    scenes = {x.scene: load_scene(x.scene) for x in found}

    def order(x: Ratio) -> tuple:
        return scenes[x.scene].model.nv, x.scene, x.batch

    lines = [
        "| scene | dofs | contact points | substeps | model | kind | batch | ratio |",
        "|---" * 8 + "|",
    ]
    for x in sorted(found, key=order):
        scene = scenes[x.scene]
        sizes = scene.model.nv, len(scene.contacts), scene.substeps
        cells = (x.scene, *sizes, f"`{x.model}`", x.kind, f"{x.batch:,}")
        shown = (*cells, written(x))
        lines.append(f"| {' | '.join(map(str, shown))} |")
    return "\n".join(lines)


def written(ratio: Ratio) -> str:
    """One number, or two where quantities differ."""
    if isnan(ratio.low):
        return "diverges"
    if not isfinite(ratio.high):
        return "MuJoCo is never so accurate"
    low, high = f"{ratio.low:.1f}", f"{ratio.high:.1f}"
    return low if low == high else f"{low} to {high}"


def reports(folder: Path) -> dict[Path, BenchReport]:
    """Every benchmark in the folder, by its file."""
    paths = sorted(folder.glob("bench_*.json"))
    return {path: read_report(path) for path in paths}


def read_report(path: Path) -> BenchReport:
    """The report in a file that `nerd bench --json` wrote; null is NaN there."""
    results = read_results(path)["results"]
    for row in results["errors"]:
        row["mean"] = nan if row["mean"] is None else row["mean"]
    errors = [ErrorRow(**row) for row in results["errors"]]
    rates = [RateRow(**row) for row in results["rates"]]
    return BenchReport(**results | {"errors": errors, "rates": rates})


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
