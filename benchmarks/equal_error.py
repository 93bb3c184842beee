"""Learned steps against MuJoCo's at equal error: the table of docs/performance.md.

    python benchmarks/equal_error.py

Of what `nerd bench SCENE --json docs/figures/bench_SCENE.json` wrote. MuJoCo's rate at the
error of a learned row lies on its own Pareto front, of all substeps and integrators of the
same race: between two rows of it on a straight line in the logarithms of error and rate,
beyond its fastest row at that row's.
"""

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from math import exp, isfinite, log
from pathlib import Path
from typing import Any

import tyro
from stability_table import FIGURES

from torchrl_nerd.evaluation.bench.pareto import pareto_front
from torchrl_nerd.scenes import load_scene

WAY = ", compiled"  # how a model runs in this table, in float32
RATES = ("steps_per_s", "envs_per_s")

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


def ratios(race: Mapping[str, Any]) -> Iterator[Ratio]:
    """Of every model of one race, batch by batch."""
    errors = {name: _means(found) for name, found in race["errors"].items()}
    true = [name for name in errors if name.startswith("MuJoCo")]
    for batch, rates in race["rates"].items():
        for name in errors:
            if not name.endswith(WAY):
                continue

            def spread(
                kind: str, name: str = name, rates: Mapping[str, Any] = rates
            ) -> tuple[float, float]:
                found = []
                for quantity, error in errors[name].items():
                    points = {x: (errors[x][quantity], rates[x][kind]) for x in true}
                    rival = rate_at(error, points)
                    own = rates[name][kind]
                    found.append(own / rival if rival else float("inf"))
                return min(found), max(found)

            model = name.removesuffix(WAY)
            yield Ratio(race["scene"], model, int(batch), *map(spread, RATES))


def _means(found: Mapping[str, Mapping[str, Any]]) -> dict[str, float]:
    """Mean error of every quantity; what is no number was not finite."""
    means = {name: error["mean"] for name, error in found.items()}
    return {name: float("inf") if x is None else x for name, x in means.items()}


def table(found: list[Ratio]) -> str:
    """Markdown, smallest robots first."""
    size: Callable[[Ratio], int] = lambda x: load_scene(x.scene).model.nv  # noqa: E731
    lines = [
        "| scene | dofs | contact points | substeps | model | rows | at equal error |"
        " in env and collector |",
        "|---" * 8 + "|",
    ]
    for x in sorted(found, key=lambda x: (size(x), x.scene, x.batch != 512, x.batch)):
        scene = load_scene(x.scene)
        points, steps = len(scene.contacts), scene.substeps
        cells = (x.scene, size(x), points, steps, f"`{x.model}`", f"{x.batch:,}")
        shown = (*cells, written(x.alone), written(x.in_env))
        lines.append(f"| {' | '.join(map(str, shown))} |")
    return "\n".join(lines)


def written(spread: tuple[float, float]) -> str:
    """One figure, or two where quantities differ."""
    if not isfinite(spread[1]):
        return "no row of MuJoCo is so exact"
    low, high = (f"{x:.1f}" for x in spread)
    return low if low == high else f"{low} to {high}"


def read(folder: Path) -> list[Ratio]:
    """Of every race in the folder; of a model that ran in two, the later file's."""
    found = {}
    for path in sorted(folder.glob("bench_*.json")):
        for ratio in ratios(json.loads(path.read_text())):
            found[ratio.scene, ratio.model, ratio.batch] = ratio
    return list(found.values())


def main(options: Options) -> None:
    """Print the table."""
    print(table(read(options.folder)))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
