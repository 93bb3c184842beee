"""All cases of a robot in true and in learned dynamics, as one table."""

import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from zlib import crc32

from torch import Generator

from torchrl_nerd.evaluation.stability.case import Case, Figures
from torchrl_nerd.evaluation.stability.cases import CASES
from torchrl_nerd.evaluation.stability.world import World


@dataclass(frozen=True)
class Result:
    """One case in both dynamics.

    | field | meaning |
    |---|---|
    | ``case``, ``physics`` | what was tried |
    | ``true``, ``learned`` | figures |
    | ``true_passes``, ``passes`` | whether they keep their lines |
    | ``lines`` | those of the learned dynamics |
    | ``seconds`` | for both |
    """

    case: str
    physics: str
    true: Figures
    learned: Figures
    true_passes: bool
    passes: bool
    lines: Figures
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
    truth: World, learned: World, cases: list[Case], seed: int = 0, scale: float = 1.0
) -> Iterator[Result]:
    """Every case that applies to the robot, one after the other.

    Args:
        truth: MuJoCo.
        learned: the same robot's model, or any env of it; cases that need more than its
            states are left out then.
        cases: which.
        seed: of starts and torques; each case has a stream of its own, the same in both.
        scale: share of the long rollouts' steps and of large batches' rows, in (0, 1].
    """
    for case in cases:
        is_blind = case.needs_dynamics and learned.dynamics is None
        if is_blind or not case.applies(learned.scene):
            continue
        began, figures = time.monotonic(), []
        for world in (truth, learned):
            stream = Generator().manual_seed(crc32(case.name.encode(), seed))
            figures.append(case.run(world, stream, scale))
        true, mine = figures
        yield Result(
            case.name,
            case.physics,
            true,
            mine,
            case.passes(true, is_true=True),
            case.passes(mine, is_true=False),
            case.lines,
            round(time.monotonic() - began, 1),
        )


def as_json(results: list[Result]) -> dict:
    """Results by case."""
    return {result.case: asdict(result) for result in results}


def as_table(results: list[Result]) -> str:
    """Markdown: a row for every figure."""
    lines = [
        "| case | figure | MuJoCo | learned | line | |",
        "|---|---|---|---|---|---|",
    ]
    for result in results:
        name = result.case
        for figure in result.learned | result.true:
            line, value = result.lines.get(figure), result.learned.get(figure)
            kept = ""
            if line is not None and value is not None:
                kept = "met" if value <= line else "**not met**"
            cells = [_shown(x) for x in (result.true.get(figure), value, line)]
            lines.append(f"| {name} | {figure} | {' | '.join(cells)} | {kept} |")
            name = ""
    return "\n".join(lines) + "\n"


def _shown(value: float | None) -> str:
    return "" if value is None else f"{value:.2g}"
