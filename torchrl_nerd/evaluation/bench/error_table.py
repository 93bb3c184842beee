"""Errors of all candidates as rows of one table, the paper's beside them."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite

from torch import Tensor

from torchrl_nerd.evaluation.rollout_error import summarize, unit_of
from torchrl_nerd.scenes import Scene

PAPER = "paper (NeRD)"
QUANTITIES = 3  # side by side: more do not fit on a line


@dataclass(frozen=True)
class ErrorRow:
    """One candidate, one case, one horizon, one quantity.

    | field | meaning |
    |---|---|
    | ``case``, ``steps`` | what was rolled out, how long |
    | ``name``, ``kind`` | of the candidate |
    | ``quantity``, ``unit`` | what is measured, in m or rad |
    | ``mean``, ``interval``, ``final``, ``p95`` | see `ErrorSummary`; None: not published |
    """

    case: str
    steps: int
    name: str
    kind: str
    quantity: str
    unit: str
    mean: float
    interval: float | None
    final: float | None
    p95: float | None


Published = Mapping[tuple[str, int, str], float]
"""(case, horizon, quantity) -> mean error, m or rad."""


def error_rows(
    scene: Scene,
    case: str,
    horizons: Sequence[int],
    errors: Mapping[tuple[str, str], Mapping[str, Tensor]],
    published: Published,
) -> Iterator[ErrorRow]:
    """Rows of one case: every horizon, every candidate in its order, the paper's last.

    Args:
        scene: the robot.
        case: its name.
        horizons: control steps over which errors are averaged.
        errors: (name, kind) -> quantity -> error at every step, ``(n, steps)``.
        published: the paper's mean errors.
    """
    for horizon in horizons:
        quantities: Iterable[str] = ()
        for (name, kind), by_name in errors.items():
            quantities = by_name.keys()
            part = {k: e[:, :horizon] for k, e in by_name.items()}  # (n, horizon)
            for quantity, error in summarize(scene, part).items():
                yield ErrorRow(case, horizon, name, kind, quantity, **vars(error))
        for quantity in quantities:
            mean = published.get((case, horizon, quantity))
            if mean is not None:
                about = (case, horizon, PAPER, "published", quantity)
                unit = unit_of(scene, quantity)
                yield ErrorRow(*about, unit, mean, interval=None, final=None, p95=None)


def error_table(
    rows: Sequence[ErrorRow], rates: Mapping[str, Mapping[str, float]] | None = None
) -> str:
    """Text of the rows of one case and horizon: a line for every candidate.

    Args:
        rows: see `error_rows`.
        rates: column -> name -> control steps per second.
    """
    quantities = list(dict.fromkeys((row.quantity, row.unit) for row in rows))
    candidates = list(dict.fromkeys((row.name, row.kind) for row in rows))
    found = {(row.name, row.quantity): row for row in rows}
    tables = []
    for first in range(0, len(quantities), QUANTITIES):
        shown = quantities[first : first + QUANTITIES]
        titles = [title for q, unit in shown for title in (f"{q} ({unit})", "", "")]
        head = ["name", "kind", *("mean", "final", "p95") * len(shown)]
        body = [
            [name, kind, *(cell for q, _ in shown for cell in _cells(found, name, q))]
            for name, kind in candidates
        ]
        for column, speeds in (rates or {}).items():
            head.append(column)
            for line in body:
                line.append(f"{speeds[line[0]]:,.0f}" if line[0] in speeds else "-")
        tables.append(text_table(head, body, titles))
    return "\n\n".join(tables)


def _cells(
    found: Mapping[tuple[str, str], ErrorRow], name: str, quantity: str
) -> list[str]:
    row = found.get((name, quantity))
    return [_shown(x) for x in ((row.mean, row.final, row.p95) if row else [None] * 3)]


def _shown(value: float | None) -> str:
    """Three digits; an error that is not finite is of a rollout that diverges."""
    if value is None:
        return "-"
    return f"{value:.3g}" if isfinite(value) else "diverges"


def text_table(
    head: Sequence[str], body: Sequence[Sequence[str]], titles: Sequence[str] = ()
) -> str:
    """Lines with aligned columns, the first two to the left.

    Args:
        head: titles of the columns.
        body: lines of cells.
        titles: over the columns after the first two; each may be as wide as three columns.
    """
    widths = [max(map(len, column)) for column in zip(head, *body, strict=True)]
    lines = [
        "  ".join(
            cell.ljust(width) if number < 2 else cell.rjust(width)
            for number, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in (head, *body)
    ]
    if titles:
        above = " " * (widths[0] + widths[1] + 2)
        for at, title in enumerate(titles):
            if title:
                above = above.ljust(sum(widths[: at + 2]) + 2 * (at + 2)) + title
        lines.insert(0, above)
    return "\n".join(lines)
