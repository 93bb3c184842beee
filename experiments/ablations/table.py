"""Results of all seeds as rows: mean and spread, final, 95th percentile, ratio to base."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import inf, prod
from statistics import mean, stdev
from typing import Any

from .variants import BASE

Results = Mapping[str, Any]
"""Of one variant and seed, see `Bed.measure`."""


@dataclass(frozen=True)
class Cell:
    """One quantity of one test of one variant, over seeds.

    | field | meaning |
    |---|---|
    | ``mean``, ``spread`` | of the seeds' mean errors; standard deviation, 0 for one seed |
    | ``final``, ``p95`` | means of the seeds' |
    | ``ratio`` | ``mean`` in base's |
    """

    mean: float
    spread: float
    final: float
    p95: float
    ratio: float


@dataclass(frozen=True)
class Row:
    """One variant.

    | field | meaning |
    |---|---|
    | ``seeds`` | that were trained |
    | ``features``, ``outputs``, ``weights`` | of its network |
    | ``seconds`` | of the processor, for one training; mean |
    | ``errors`` | test -> quantity -> `Cell` |
    """

    name: str
    what: str
    seeds: tuple[int, ...]
    features: int
    outputs: int
    weights: int
    seconds: float
    errors: dict[str, dict[str, Cell]]

    def ratio(self, case: str) -> float:
        """Geometric mean over the quantities of a test."""
        ratios = [cell.ratio for cell in self.errors[case].values()]
        return prod(ratios) ** (1.0 / len(ratios))


def rows_of(found: Sequence[Results]) -> list[Row]:
    """A row for each variant of one scene, in order, against the base's same seeds."""
    by_name: dict[str, list[Results]] = {}
    for results in found:
        by_name.setdefault(results["variant"], []).append(results)
    rows = []
    for name, runs in by_name.items():
        seeds = tuple(run["seed"] for run in runs)
        base = [run for run in by_name[BASE] if run["seed"] in seeds]
        errors = {
            case: {
                quantity: cell_of(runs, base, case, quantity) for quantity in quantities
            }
            for case, quantities in runs[0]["errors"].items()
        }
        first = runs[0]
        sizes = first["features"], first["outputs"], first["weights"]
        seconds = mean(run["seconds"] for run in runs)
        rows.append(Row(name, first["what"], seeds, *sizes, seconds, errors))
    return rows


def cell_of(
    runs: Sequence[Results], base: Sequence[Results], case: str, quantity: str
) -> Cell:
    """One quantity of one test, of a variant's seeds and of the base's same ones."""

    def all_of(runs: Sequence[Results], kind: str) -> list[float]:
        found = (run["errors"][case][quantity][kind] for run in runs)
        return [inf if x is None else x for x in found]  # null: it was not finite

    means = all_of(runs, "mean")
    spread = stdev(means) if len(means) > 1 and inf not in means else 0.0
    final, p95 = mean(all_of(runs, "final")), mean(all_of(runs, "p95"))
    ratio = mean(means) / mean(all_of(base, "mean"))
    return Cell(mean(means), spread, final, p95, ratio)


def markdown(rows: Sequence[Row], units: Mapping[str, str]) -> Iterator[str]:
    """Lines of one table for each test, then of what every variant is and took.

    Args:
        rows: of one scene.
        units: of every quantity.
    """
    for case in rows[0].errors:
        names = list(rows[0].errors[case])
        heads = [f"{name}, {units[name]} | ratio" for name in names]
        yield f"| {case}: mean ± spread / final / 95% | {' | '.join(heads)} |"
        yield "|---" * (1 + 2 * len(names)) + "|"
        for row in rows:
            cells = (written(row.errors[case][name]) for name in names)
            yield f"| {row.name} | {' | '.join(cells)} |"
        yield ""
    yield "| variant | what differs | features | outputs | weights | s | seeds |"
    yield "|---" * 7 + "|"
    for row in rows:
        sizes = f"{row.features} | {row.outputs} | {row.weights:,} | {row.seconds:.0f}"
        yield f"| {row.name} | {row.what} | {sizes} | {len(row.seeds)} |"


def written(cell: Cell) -> str:
    """Two cells: the errors, and the ratio."""
    spread = f"{cell.mean:.4f} ± {cell.spread:.4f}"
    return f"{spread} / {cell.final:.4f} / {cell.p95:.4f} | {cell.ratio:.2f}"
