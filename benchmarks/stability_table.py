"""The tables of docs/stability.md from what `nerd stability SCENE --json` wrote.

    python benchmarks/stability_table.py

A figure of the learned dynamics, MuJoCo's in brackets where it shows another number, bold
where its line is not met.
"""

import json
from dataclasses import dataclass
from pathlib import Path

import tyro

FIGURES = Path(__file__).parents[1] / "docs" / "figures"
SCENES = {
    "ant": "Ant",
    "anymal": "ANYmal",
    "double_pendulum": "double pendulum",
    "cube": "cube",
    "cube_real": "`cube_real`",
    "cube_slope": "`cube_slope`",
    "franka": "Franka",
    "franka_gravity": "`franka_gravity`",
    "cartpole": "Cartpole",
}
WITHOUT_LINE = {
    "adversary": ["worst that the search found"],
    "chaos": ["Lyapunov times", "chaos floor of a nudge of 1e-6"],
    "drop": ["height at the end, dropped 10 m, against MuJoCo, m"],
    "gradients": ["largest gradient after 100 steps"],
    "horizon": ["largest speed, m/s or rad/s"],
    "joint_limits": ["MuJoCo goes beyond by"],
    "precision": [
        "float32 against float64 after 100 steps",
        "bfloat16 after 100 steps",
    ],
    "sliding": ["stops beside MuJoCo, m, mean"],
    "stiff_contact": [
        "mean error against the stiffer ground, m or rad",
        "what the stiffness changes in MuJoCo",
    ],
    "torques": ["largest speed, alternating"],
}

Figures = dict[str, dict]
"""What was measured of every scene, by its name, as the command wrote it."""


@dataclass
class Options:
    """Where the figures are."""

    folder: Path = FIGURES


def read(folder: Path) -> Figures:
    """The figures of every scene that has some."""
    paths = {name: folder / f"stability_{name}.json" for name in SCENES}
    return {name: json.loads(p.read_text()) for name, p in paths.items() if p.exists()}


def with_lines(found: Figures) -> str:
    """Every figure that has a line, a row each."""
    names = sorted(
        {case for one in found.values() for case in one if _is_case(one, case)}
    )
    rows = []
    for case in names:
        of_case = {name: one[case] for name, one in found.items() if case in one}
        lines: dict[str, float] = {}
        for one in of_case.values():
            lines |= one["lines"]
        rows += [
            (case, figure, _cells(found, of_case, figure), number(line))
            for figure, line in lines.items()
        ]
    return _table(found, rows)


def without_lines(found: Figures) -> str:
    """Some figures for information."""
    rows = []
    for case, figures in WITHOUT_LINE.items():
        of_case = {name: one[case] for name, one in found.items() if case in one}
        rows += [(case, f, _cells(found, of_case, f), None) for f in figures]
    return _table(found, rows)


def number(value: float | None) -> str:
    """Two digits, and no more signs than it takes; what is no number was refused."""
    if value is None:
        return "refused"
    digits = f"{value:.2g}"
    if "e" not in digits:
        return digits
    mantissa, exponent = digits.split("e")
    return f"{mantissa}e{int(exponent)}"


def _is_case(one: dict, name: str) -> bool:
    return isinstance(one[name], dict) and bool(one[name]["lines"])


def _cells(found: Figures, of_case: Figures, figure: str) -> list[str]:
    return [_cell(of_case.get(name), figure) for name in found]


def _cell(result: dict | None, figure: str) -> str:
    if result is None or figure not in result["learned"]:
        return ""
    value, true = (result[key].get(figure) for key in ("learned", "true"))
    shown, line = number(value), result["lines"].get(figure)
    if line is not None and (value is None or not value <= line):
        shown = f"**{shown}**"
    is_same = true is None or number(true) == number(value)
    return shown if is_same else f"{shown} ({number(true)})"


def _table(found: Figures, rows: list) -> str:
    has_lines = any(line is not None for *_, line in rows)
    head = ["case", "figure", *(SCENES[name] for name in found)]
    head += ["line"] * has_lines
    table, last = [head, ["---"] * len(head)], None
    for case, figure, cells, line in rows:
        name = "" if case == last else f"`{case}`"
        table.append([name, figure, *cells, *([line] if has_lines else [])])
        last = case
    lines = [f"| {' | '.join(row)} |" for row in table]
    lines[1] = lines[1].replace(" ", "")
    return "\n".join(lines)


def main(options: Options) -> None:
    """Print both tables."""
    found = read(options.folder)
    print(with_lines(found), without_lines(found), sep="\n\n")


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
