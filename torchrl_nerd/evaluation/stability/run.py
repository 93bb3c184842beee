"""All cases of a robot in MuJoCo and in the dynamics under test: table and picture."""

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from zlib import crc32

from torch import Generator

from torchrl_nerd.evaluation.plots import COLORS, make_figure, save_figure
from torchrl_nerd.evaluation.stability.case import Case, Metrics, Trial
from torchrl_nerd.evaluation.stability.cases import CASES
from torchrl_nerd.evaluation.stability.stepper import Stepper

LEAST, MOST = 1e-6, 1e6  # ratios beyond are clipped in the picture
BAR = 0.24  # inches
PASS, FAIL = COLORS[2], COLORS[1]


@dataclass(frozen=True)
class Result:
    """One case in both dynamics.

    | field | meaning |
    |---|---|
    | ``case``, ``physics`` | what was tried |
    | ``ground_truth``, ``tested`` | metrics; none of MuJoCo where a model is needed |
    | ``ground_truth_passes``, ``passes`` | whether they are within their tolerances |
    | ``tolerances`` | those of the dynamics under test |
    | ``seconds`` | for both |
    """

    case: str
    physics: str
    ground_truth: Metrics
    tested: Metrics
    ground_truth_passes: bool
    passes: bool
    tolerances: Metrics
    seconds: float


def choose_cases(names: list[str] | None) -> list[Case]:
    """Cases by name, all where none is named.

    Raises:
        ValueError: no such case.
    """
    for name in names or []:
        if name not in CASES:
            known = ", ".join(CASES)
            raise ValueError(f"unknown case '{name}', expected one of {known}")
    return [CASES[name] for name in names or CASES]


def run_cases(
    ground_truth: Stepper,
    tested: Stepper,
    cases: list[Case],
    seed: int = 0,
    scale: float = 1.0,
) -> Iterator[Result]:
    """Every case that applies, one after the other.

    Args:
        ground_truth: MuJoCo.
        tested: other dynamics of the same robot, or any env of it; cases that need more
            than it offers are left out.
        cases: which.
        seed: of starts and torques; each case has a stream of its own, the same in both.
        scale: fraction of long rollouts and large batches, in (0, 1].
    """
    for case in cases:
        if not case.supports(tested):
            continue
        began, found = time.monotonic(), []
        for stepper in (ground_truth, tested):
            stream = Generator().manual_seed(crc32(case.name.encode(), seed))
            trial = Trial(stepper, stream, scale)
            found.append(case.run(trial) if case.supports(stepper) else {})
        exact, mine = found
        yield Result(
            case.name,
            case.physics,
            exact,
            mine,
            case.passes(exact, is_ground_truth=True),
            case.passes(mine, is_ground_truth=False),
            case.tolerances,
            round(time.monotonic() - began, 1),
        )


def as_table(results: list[Result], kind: str = "tested") -> str:
    """Markdown: one line per metric; ``kind`` heads the tested dynamics' column."""
    lines = [
        f"| case | metric | MuJoCo | {kind} | tolerance | |",
        "|---|---|---|---|---|---|",
    ]
    for result in results:
        name = result.case
        for metric in result.tested | result.ground_truth:
            limit, value = result.tolerances.get(metric), result.tested.get(metric)
            verdict = ""
            if limit is not None and value is not None:
                verdict = "pass" if value <= limit else "**fail**"
            shown = (result.ground_truth.get(metric), value, limit)
            cells = " | ".join("" if x is None else f"{x:.2g}" for x in shown)
            lines.append(f"| {name} | {metric} | {cells} | {verdict} |")
            name = ""
    return "\n".join(lines) + "\n"


def plot_results(results: list[Result], path: Path, title: str) -> None:
    """A PNG with every metric relative to its tolerance; above one it fails."""
    names, ratios = [], []
    for result in results:
        for metric, limit in result.tolerances.items():
            names.append(f"{result.case}: {metric}")
            value = result.tested[metric]
            ratio = value / limit if limit else (LEAST if value == 0 else MOST)
            ratios.append(min(max(ratio, LEAST), MOST))
    figure, (axes,) = make_figure(1, height=BAR * len(names) + 1.2)
    colors = [PASS if ratio <= 1.0 else FAIL for ratio in ratios]
    axes.barh(range(len(names)), [r - LEAST for r in ratios], left=LEAST, color=colors)
    axes.set_yticks(range(len(names)), names, fontsize=7)
    axes.invert_yaxis()
    axes.axvline(1.0, color="black", linewidth=1)
    label = "metric relative to its tolerance (green: pass; smaller is better)"
    limits = (LEAST, 10.0 * max(1.0, *ratios))
    axes.set(xscale="log", xlim=limits, xlabel=label, title=title)
    save_figure(figure, path)
