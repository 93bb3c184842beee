"""All cases of a robot in MuJoCo and in the dynamics under test, as one table."""

import time
from collections.abc import Iterator
from dataclasses import dataclass
from zlib import crc32

from torch import Generator

from torchrl_nerd.dynamics import Dynamics, MujocoDynamics
from torchrl_nerd.evaluation.stability.case import Case, Metrics, Trial
from torchrl_nerd.evaluation.stability.cases import CASES
from torchrl_nerd.settings import look_up


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
    return [look_up("case", name, CASES) for name in names or CASES]


def run_cases(
    tested: Dynamics,
    cases: list[Case],
    seed: int = 0,
    scale: float = 1.0,
    ground_truth: Dynamics | None = None,
) -> Iterator[Result]:
    """Every case that applies, one after the other.

    Args:
        tested: any dynamics; cases of models are left out for others.
        cases: which.
        seed: of starts and torques; each case has a stream of its own, the same in both.
        scale: fraction of long rollouts and large batches, in (0, 1].
        ground_truth: what stands beside it; by default MuJoCo.
    """
    ground_truth = ground_truth or MujocoDynamics(tested.scene)
    for case in cases:
        if not case.supports(tested):
            continue
        began, found = time.monotonic(), []
        for dynamics in (ground_truth, tested):
            stream = Generator().manual_seed(crc32(case.name.encode(), seed))
            trial = Trial(dynamics, stream, scale)
            found.append(case.run(trial) if case.supports(dynamics) else {})
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
