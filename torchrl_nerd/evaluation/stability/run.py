"""All cases of a robot in MuJoCo and in the dynamics under test, as one table."""

import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from zlib import crc32

from torch import Generator

from torchrl_nerd.evaluation.stability.case import Case, Metrics, Trial
from torchrl_nerd.evaluation.stability.cases import CASES
from torchrl_nerd.evaluation.stability.stepper import Stepper


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


def as_json(results: list[Result]) -> dict:
    """Results by case."""
    return {result.case: asdict(result) for result in results}


def as_table(results: list[Result], kind: str = "tested") -> str:
    """Markdown: one line per metric.

    Args:
        results: from `run_cases`.
        kind: header of the column of the dynamics under test.
    """
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
            exact = result.ground_truth.get(metric)
            cells = [_two_digits(x) for x in (exact, value, limit)]
            lines.append(f"| {name} | {metric} | {' | '.join(cells)} | {verdict} |")
            name = ""
    return "\n".join(lines) + "\n"


def _two_digits(value: float | None) -> str:
    return "" if value is None else f"{value:.2g}"
