"""The tables of docs/stability.md from what `nerd stability SCENE --json` wrote.

    python experiments/stability_table.py

One metric per row: the model's, MuJoCo's in brackets where it differs, bold where it fails.
"""

from dataclasses import dataclass
from pathlib import Path

import tyro

from torchrl_nerd.evaluation.results import read_results

RESULTS = Path(__file__).parents[1] / "results"
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
INFORMATION = {
    "adversary": ["largest error found by the search, m or rad"],
    "sensitivity": [
        "time until the error exceeds 0.3, Lyapunov times",
        "sensitivity of MuJoCo to starts 1e-6 apart, m or rad",
    ],
    "drop": ["final height error, dropped from 10 m, m"],
    "gradients": ["largest gradient after 100 steps"],
    "horizon": ["largest speed, m/s or rad/s"],
    "joint_limits": ["limit exceeded in MuJoCo, rad or m"],
    "precision": [
        "float32 against float64 after 100 steps",
        "bfloat16 against float64 after 100 steps",
    ],
    "sliding": ["mean error of the stopping point, m"],
    "stiff_contact": [
        "mean error against the stiffer ground, m or rad",
        "mean difference between the two in MuJoCo, m or rad",
    ],
    "torques": ["largest speed, alternating"],
}

Results = dict[str, dict]
"""What was measured of every scene, by its name, as the command wrote it."""


@dataclass
class Options:
    """Where the results are."""

    folder: Path = RESULTS


def read(folder: Path) -> Results:
    """The results of every scene that has some."""
    paths = {name: folder / f"stability_{name}.json" for name in SCENES}
    return {n: read_results(p)["results"] for n, p in paths.items() if p.exists()}


def graded(found: Results) -> str:
    """Every metric with a tolerance, a row each."""
    names = sorted(
        {case for one in found.values() for case in one if _is_case(one, case)}
    )
    rows = []
    for case in names:
        of_case = {name: one[case] for name, one in found.items() if case in one}
        limits: dict[str, float] = {}
        for one in of_case.values():
            limits |= one["tolerances"]
        rows += [
            (case, metric, _cells(found, of_case, metric), number(limit))
            for metric, limit in limits.items()
        ]
    return _table(found, rows)


def informative(found: Results) -> str:
    """Some metrics without a tolerance."""
    rows = []
    for case, metrics in INFORMATION.items():
        of_case = {name: one[case] for name, one in found.items() if case in one}
        rows += [(case, m, _cells(found, of_case, m), None) for m in metrics]
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
    return isinstance(one[name], dict) and bool(one[name]["tolerances"])


def _cells(found: Results, of_case: Results, metric: str) -> list[str]:
    return [_cell(of_case.get(name), metric) for name in found]


def _cell(result: dict | None, metric: str) -> str:
    if result is None or metric not in result["tested"]:
        return ""
    value, exact = (result[key].get(metric) for key in ("tested", "ground_truth"))
    shown, limit = number(value), result["tolerances"].get(metric)
    if limit is not None and (value is None or not value <= limit):
        shown = f"**{shown}**"
    is_same = exact is None or number(exact) == number(value)
    return shown if is_same else f"{shown} ({number(exact)})"


def _table(found: Results, rows: list) -> str:
    is_graded = any(limit is not None for *_, limit in rows)
    head = ["case", "metric", *(SCENES[name] for name in found)]
    head += ["tolerance"] * is_graded
    table, last = [head, ["---"] * len(head)], None
    for case, metric, cells, limit in rows:
        name = "" if case == last else f"`{case}`"
        table.append([name, metric, *cells, *([limit] if is_graded else [])])
        last = case
    lines = [f"| {' | '.join(row)} |" for row in table]
    lines[1] = lines[1].replace(" ", "")
    return "\n".join(lines)


def main(options: Options) -> None:
    """Print both tables."""
    found = read(options.folder)
    print(graded(found), informative(found), sep="\n\n")


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
