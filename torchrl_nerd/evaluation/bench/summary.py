"""Mean errors of all cases in one table; models that are worse than cheap rivals."""

from collections import Counter
from collections.abc import Sequence
from math import isfinite

from torchrl_nerd.evaluation.bench.candidates import KINDS
from torchrl_nerd.evaluation.bench.errors import GROUND_TRUTH, ErrorRow, error_text
from torchrl_nerd.evaluation.tables import text_table
from torchrl_nerd.geometry.manifold import joint_label
from torchrl_nerd.scenes import Scene

COLUMNS = 9  # of numbers side by side: more do not fit on a line
MODELS = KINDS[2:]
"""Kinds of what is meant to be better than MuJoCo at one substep."""

Column = tuple[str, int, str, str]
"""Case, control steps, quantity and unit of a mean error."""


def summary(scene: Scene, rows: Sequence[ErrorRow]) -> dict[str, dict[Column, float]]:
    """Mean errors of every candidate; several joints of one unit are one: their mean.

    Args:
        scene: the robot.
        rows: of all cases and horizons, see `error_rows`. A quantity that a row lacks is
            left out of the mean; NaN: the rollout diverges.
    """
    labels = {joint_label(scene.model, joint) for joint in range(scene.model.njnt)}
    joints = {(r.quantity, r.unit) for r in rows if r.quantity in labels}
    count = Counter(unit for _, unit in joints)
    found: dict[str, dict[Column, list[float]]] = {}
    for row in rows:
        is_one_of = row.quantity in labels and count[row.unit] > 1
        column = row.case, row.steps, "joints" if is_one_of else row.quantity, row.unit
        found.setdefault(row.name, {}).setdefault(column, []).append(row.mean)
    return {
        name: {column: sum(x) / len(x) for column, x in errors.items()}
        for name, errors in found.items()
    }


def summary_table(scene: Scene, rows: Sequence[ErrorRow]) -> str:
    """One line per candidate, one column per case, horizon and quantity.

    Cases that do not fit on a line follow in a second table.
    """
    errors, kinds = summary(scene, rows), {row.name: row.kind for row in rows}
    columns = list(dict.fromkeys(c for by_column in errors.values() for c in by_column))
    parts: list[list[Column]] = [[]]
    for case in dict.fromkeys(column[0] for column in columns):
        block = [column for column in columns if column[0] == case]
        if parts[-1] and len(parts[-1]) + len(block) > COLUMNS:
            parts.append([])
        parts[-1] += block
    tables = []
    for part in parts:
        cases, steps, quantities, units = zip(*part, strict=True)
        body = [
            ["", "steps", *map(str, steps)],
            ["", "mean error", *quantities],
            ["name", "kind", *units],
        ]
        for name, found in errors.items():
            cells = (error_text(found.get(column)) for column in part)
            body.append([name, kinds[name], *cells])
        tables.append(text_table(["", "case", *cases], body))
    return "\n\n".join(tables)


def warnings(scene: Scene, rows: Sequence[ErrorRow]) -> list[str]:
    """A sentence for each model that is worse than no motion or MuJoCo at one substep."""
    errors, kinds = summary(scene, rows), {row.name: row.kind for row in rows}
    coarse = [name for name in kinds if name.endswith(" 1 substep")]
    rivals = ["no motion", *coarse[:1]]  # the scene's own integrator is first
    rivals = [name for name in rivals if kinds[name] != GROUND_TRUTH]
    sentences = []
    for name, found in errors.items():
        worse = [
            f"than {rival} in {where}"
            for rival in rivals
            if kinds[name] in MODELS and (where := _where(found, errors[rival]))
        ]
        if worse:
            sentences.append(f"{name} has a larger mean error {', and '.join(worse)}.")
    return sentences


def _where(found: dict[Column, float], rival: dict[Column, float]) -> str:
    """Cases in which an error is not below a rival's that is finite; "" for none."""
    worse = [c for c, x in found.items() if isfinite(rival[c]) and not x <= rival[c]]
    if len(worse) == len(found):
        return "every case"
    return ", ".join(
        dict.fromkeys(f"{case} ({steps} steps)" for case, steps, *_ in worse)
    )
