"""The benchmark of a scene: error and speed of every candidate, and which to choose."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.evaluation.bench.candidates import (
    models,
    mujoco_name,
    simulators,
)
from torchrl_nerd.evaluation.bench.error_table import (
    PAPER,
    ErrorRow,
    error_rows,
    error_table,
    text_table,
)
from torchrl_nerd.evaluation.bench.evaluation_set import evaluation_set
from torchrl_nerd.evaluation.bench.rates import RateRow, rate_rows
from torchrl_nerd.robots import EvaluationProtocol, make_task, protocol_of
from torchrl_nerd.scenes import Scene
from torchrl_nerd.settings import expect_at_least
from torchrl_nerd.tasks import Task

FINEST = 64  # substeps of a ground truth in contact, or four times the scene's own
PERTURBATION = 1e-4  # m and rad, of every coordinate of the initial state
ALL = "all"
"""The case of all cases together."""


@dataclass(frozen=True)
class BenchReport:
    """What `bench` measured.

    | field | meaning |
    |---|---|
    | ``scene``, ``steps``, ``num_trajectories`` | rolled out, how long, how many a case |
    | ``ground_truth`` | what errors are measured against |
    | ``errors`` | rows over all cases together, see `ErrorRow` |
    | ``rates`` | rows of every batch, see `RateRow` |
    """

    scene: str
    steps: int
    num_trajectories: int
    ground_truth: str
    errors: list[ErrorRow]
    rates: list[RateRow]

    @property
    def batches(self) -> list[int]:
        """Trajectories stepped together, for the rates."""
        return list(dict.fromkeys(row.batch for row in self.rates))

    @property
    def batch(self) -> int:
        """The one that is shown first: 512, or the largest there is."""
        return 512 if 512 in self.batches else max(self.batches)

    def speeds(self, batch: int) -> dict[str, float]:
        """Control steps per second by name."""
        return {row.name: row.steps_per_s for row in self.rates if row.batch == batch}

    def points(self, batch: int, quantity: str) -> dict[str, tuple[float, float]]:
        """Mean error of a quantity, and steps per second, by name."""
        speeds = self.speeds(batch)
        return {
            row.name: (row.mean, speeds[row.name])
            for row in self.errors
            if row.quantity == quantity and row.name in speeds
        }

    def within(self, budget: Mapping[str, float], batch: int) -> str | None:
        """The fastest candidate whose mean errors are all within the budget, or None."""
        speeds = self.speeds(batch)
        too_large = {
            row.name
            for row in self.errors
            if not row.mean <= budget.get(row.quantity, float("inf"))
        }
        fit = [name for name in speeds if name not in too_large]
        return max(fit, key=lambda name: speeds[name], default=None)

    @property
    def published(self) -> dict[str, float]:
        """The paper's mean error by quantity, where it published one."""
        return {row.quantity: row.mean for row in self.errors if row.name == PAPER}

    def results(self) -> dict[str, Any]:
        """Everything as JSON has it."""
        return asdict(self)

    @classmethod
    def from_results(cls, results: Mapping[str, Any]) -> "BenchReport":
        """The report whose `results` these are, as read from JSON; null is NaN."""
        errors = [
            ErrorRow(
                **row | {"mean": float("nan") if row["mean"] is None else row["mean"]}
            )
            for row in results["errors"]
        ]
        rates = [RateRow(**row) for row in results["rates"]]
        return cls(**{**results, "errors": errors, "rates": rates})


def pareto_front(points: Mapping[str, tuple[float, float]]) -> list[str]:
    """Names that no other beats in both error and rate, the most accurate first.

    Args:
        points: name -> (error, steps per second); points that are not finite never win.
    """
    front: list[str] = []
    fastest = 0.0
    finite = {name: p for name, p in points.items() if p[0] < float("inf")}
    for name, (_, rate) in sorted(finite.items(), key=lambda x: (x[1][0], -x[1][1])):
        if rate > fastest:
            front.append(name)
            fastest = rate
    return front


def reference_of(scene: Scene) -> Scene:
    """The scene with a solver so fine that its own error no longer counts.

    RK4 where nothing touches; contacts leave it no order to gain, and take more substeps.
    """
    if scene.terrain is None:
        return scene.reference
    return scene.with_substeps(max(FINEST, 4 * scene.substeps))


def bench(
    scene: Scene,
    batches: Sequence[int] = (1, 64, 512, 4096),
    num_trajectories: int = 256,
    rounds: int = 5,
    seed: int = 500,
    steps: int | None = None,
    variants: Sequence[str] = ("compiled",),
    threads: int | None = None,
    device: torch.device | str = "cpu",
    quiet: bool = False,
    without: Sequence[str] = (),
    names: Sequence[str] = (),
) -> BenchReport:
    """Error and speed of MuJoCo and of the models of a scene on this machine.

    Args:
        scene: one that has a task.
        batches: trajectories stepped together, for the rates.
        num_trajectories: of each case, for the errors.
        rounds: samples of each candidate's speed.
        seed: of the initial states.
        steps: horizon of the errors; the protocol's by default.
        variants: other ways to run each model, see `VARIANTS`.
        threads: processors to use; torch's own choice by default.
        device: of learned models and of every state whose steps are timed; MuJoCo's
            states then travel to the processor and back within its time.
        quiet: no progress bars.
        without: candidates with one of these in their names are left out.
        names: of models, see `models`.

    Raises:
        ValueError: a scene without a task, a setting out of range, or no candidate left.
    """
    expect_at_least(1, rounds=rounds, **{f"batch {b}": b for b in batches})
    expect_at_least(2, num_trajectories=num_trajectories)
    protocol = protocol_of(scene)
    task = _task_of(scene, protocol)
    if threads is not None:
        torch.set_num_threads(threads)
    threads = torch.get_num_threads()
    everyone = [*simulators(scene, threads), *models(scene, names, device, variants)]
    candidates = [c for c in everyone if not any(word in c.name for word in without)]
    if not candidates:
        raise ValueError(
            f"expected candidates to measure, got none without {', '.join(without)}"
        )
    published = {horizon for _, horizon, _ in protocol.published}
    horizon = steps or max(published or protocol.horizons)

    def ground_truth(here: Scene) -> MujocoDynamics:
        return MujocoDynamics(reference_of(here), threads)

    sets = [
        evaluation_set(
            *(case, source, case in protocol.random_actions, ground_truth),
            *(num_trajectories, horizon, seed, device),
        )
        for case, source in protocol.cases.items()
    ]
    errors = {
        (c.name, c.kind): _together([s.errors(c.make(s.scene)) for s in sets])
        for c in tqdm(candidates, "errors", disable=quiet)
    }
    name = f"ground truth, perturbed by {PERTURBATION:.0e}"
    errors[name, "sensitivity"] = _together(
        [s.errors(ground_truth(s.scene), s.perturbed(PERTURBATION, seed)) for s in sets]
    )
    moving = [c for c in candidates if c.kind != "baseline"]
    rates = [
        row
        for batch in tqdm(batches, "rates", unit=" batches", disable=quiet)
        for row in rate_rows(moving, task, batch, rounds, seed, device)
    ]
    case = ALL if len(sets) > 1 else sets[0].case
    paper = _published(protocol, horizon, case)
    return BenchReport(
        scene=scene.name,
        steps=horizon,
        num_trajectories=num_trajectories,
        ground_truth=mujoco_name(reference_of(task.scene)),
        errors=list(error_rows(scene, case, [horizon], errors, paper)),
        rates=rates,
    )


def bench_table(report: BenchReport) -> str:
    """A table of errors with rates, one of all rates, and which candidate to choose.

    ``*`` marks candidates that no other beats in both error and rate.
    """
    quantities = list(dict.fromkeys(row.quantity for row in report.errors))
    batch = report.batch
    lines = [
        f"{report.scene}: {report.steps} steps, {report.num_trajectories} trajectories a "
        f"case. Errors are against {report.ground_truth} (ground truth); steps/s with a "
        f"batch of {batch}.",
        "",
        error_table(report.errors, report.speeds(batch)),
        "",
    ]
    fronts = {
        b: {name for q in quantities for name in pareto_front(report.points(b, q))}
        for b in report.batches
    }
    head = ["control steps/s", "kind"]
    for b in report.batches:
        head += [f"batch {b}", "in env"]
    by_name: dict[tuple[str, str], list[RateRow]] = {}
    for row in report.rates:
        by_name.setdefault((row.name, row.kind), []).append(row)
    body = []
    for (name, kind), rows in by_name.items():
        line = [name, kind]
        for row in rows:
            mark = "*" if name in fronts[row.batch] else " "
            line += [f"{row.steps_per_s:,.0f}{mark}", f"{row.env_steps_per_s:,.0f}"]
        body.append([*line, f"{max(row.warm_up_s for row in rows):.1f}"])
    lines.append(text_table([*head, "warm-up (s)"], body))
    if set(report.published) == set(quantities):
        lines.append("")
        for b in report.batches:
            choice = report.within(report.published, b) or "none"
            lines.append(f"fastest within the paper's error, batch {b}: {choice}")
    return "\n".join(lines)


def _together(parts: list[dict[str, Tensor]]) -> dict[str, Tensor]:
    """Errors of all cases as one."""
    return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}


def _task_of(scene: Scene, protocol: EvaluationProtocol) -> Task:
    """Whose initial states, observations, rewards and resets are timed."""
    tasks = [case for case in protocol.cases.values() if isinstance(case, Task)]
    if tasks:
        return tasks[-1]
    try:
        return make_task(scene.name)
    except ValueError:
        raise ValueError(
            f"expected a robot with a task, such as ant or dm_control/humanoid-run, got "
            f"'{scene.name}', which has none"
        ) from None


def _published(
    protocol: EvaluationProtocol, horizon: int, case: str
) -> dict[tuple[str, int, str], float]:
    """Means over the cases of what the paper published at this horizon."""
    found: dict[str, list[float]] = {}
    for (_, steps, quantity), error in protocol.published.items():
        if steps == horizon:
            found.setdefault(quantity, []).append(error)
    return {(case, horizon, q): sum(x) / len(x) for q, x in found.items()}
