"""The benchmark of a scene: error and speed of every candidate."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import torch
import tyro
from tqdm import tqdm

from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.evaluation.bench.candidates import models, simulators
from torchrl_nerd.evaluation.bench.errors import (
    ErrorRow,
    error_rows,
    error_table,
    evaluation_set,
    measure,
    together,
)
from torchrl_nerd.evaluation.bench.rates import RateRow, rate_rows
from torchrl_nerd.robots import EvaluationProtocol, protocol_of
from torchrl_nerd.scenes import Scene
from torchrl_nerd.settings import expect_at_least

FINEST = 64  # substeps of a ground truth in contact, or four times the scene's own
PERTURBATION = 1e-4  # m and rad, of every coordinate of the initial positions
ALL = "all"
"""The case of all cases together."""


@dataclass(frozen=True, kw_only=True)
class BenchConfig:
    """What `bench` measures, and how finely."""

    models: Annotated[tuple[str, ...], tyro.conf.arg(aliases=("--model",))] = ()
    """Names of models or checkpoint folders; by default all that are shipped for the
    robot."""
    variants: tuple[str, ...] = ("compiled",)
    """Other ways to run each model, see nerd eval: compiled, window, bf16."""
    batches: tuple[int, ...] = (1, 64, 512, 4096)
    """How many trajectories are stepped together, for the rates."""
    num_trajectories: int = 256
    """How many trajectories of each case the errors are means of."""
    rounds: int = 5
    """Samples of each candidate's speed; the median is shown."""
    seed: int = 500
    """Of the initial states."""
    steps: int | None = None
    """Horizon of the errors; the paper's by default."""

    def check(self) -> None:
        """Refuse a number out of range with a SettingError."""
        counts = {f"batch {batch}": batch for batch in self.batches}
        counts |= {} if self.steps is None else {"steps": self.steps}
        expect_at_least(1, rounds=self.rounds, batches=len(self.batches), **counts)
        expect_at_least(2, num_trajectories=self.num_trajectories)


@dataclass(frozen=True)
class BenchReport:
    """What `bench` measured; ``asdict`` of it is what JSON holds."""

    scene: str
    steps: int  # the horizon of the errors
    num_trajectories: int  # of each case
    ground_truth: str  # the solver that errors are measured against
    errors: list[ErrorRow]  # over all cases together
    rates: list[RateRow]  # of every batch

    @property
    def batches(self) -> list[int]:
        """Trajectories stepped together, for the rates."""
        return list(dict.fromkeys(row.batch for row in self.rates))

    @property
    def batch(self) -> int:
        """The one that is compared by: 512, or the largest there is."""
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


def pareto_front(points: Mapping[str, tuple[float, float]]) -> list[str]:
    """Names that no other beats in both error and rate, the most accurate first.

    ``points``: name -> (error, steps per second); those that are not finite never win.
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
    config: BenchConfig,
    device: torch.device | str = "cpu",
    quiet: bool = False,
) -> BenchReport:
    """Error and speed of MuJoCo and of the models of a scene on this machine.

    ``device``: of learned models and of every state whose steps are timed; MuJoCo's states
    then travel to the processor and back within its time.

    Raises:
        ValueError: a setting out of range, or no such model.
    """
    config.check()
    protocol = protocol_of(scene)
    threads = torch.get_num_threads()  # as many for MuJoCo
    candidates = simulators(scene, threads)
    candidates += models(scene, config.models, device, config.variants)
    published = {horizon for _, horizon, _ in protocol.published}
    horizon = config.steps or max(published or protocol.horizons)

    def ground_truth(here: Scene) -> MujocoDynamics:
        return MujocoDynamics(reference_of(here), threads)

    sets = [
        evaluation_set(
            case,
            source,
            case in protocol.random_actions,
            ground_truth,
            config.num_trajectories,
            horizon,
            config.seed + number,  # other starts than those of the cases before
            device,
        )
        for number, (case, source) in enumerate(protocol.cases.items())
    ]
    errors = measure(sets, candidates, quiet=quiet)
    name = f"ground truth, perturbed by {PERTURBATION:.0e}"
    shake = PERTURBATION, config.seed
    errors[name, "sensitivity"] = together(
        [s.errors(ground_truth(s.scene), s.perturbed(*shake)) for s in sets]
    )
    moving = [c for c in candidates if c.kind != "baseline"]
    rates, how = [], (config.rounds, config.seed, device)
    for batch in tqdm(config.batches, "rates", unit=" batches", disable=quiet):
        rates += rate_rows(moving, sets[-1].source, batch, *how)
    case = ALL if len(sets) > 1 else sets[0].case
    paper = _published(protocol, horizon, case)
    return BenchReport(
        scene=scene.name,
        steps=horizon,
        num_trajectories=config.num_trajectories,
        ground_truth=sets[-1].solver,
        errors=error_rows(scene, case, horizon, errors, paper),
        rates=rates,
    )


def bench_table(report: BenchReport) -> str:
    """Errors with rates as text, and which candidates nothing beats in both."""
    rates = {f"batch {b}": report.speeds(b) for b in report.batches}
    lines = [
        f"{report.scene}: {report.steps} steps, {report.num_trajectories} trajectories per "
        f"case. Ground truth: {report.ground_truth}. Rates in control steps/s.\n",
        f"{error_table(report.errors, rates)}\n",
    ]
    for quantity in dict.fromkeys(row.quantity for row in report.errors):
        front = pareto_front(report.points(report.batch, quantity))
        about = f"Pareto front of {quantity} and rate, batch {report.batch}"
        lines.append(f"{about}: {'; '.join(front)}")
    return "\n".join(lines)


def _published(
    protocol: EvaluationProtocol, horizon: int, case: str
) -> dict[tuple[str, int, str], float]:
    """Means over the cases of what the paper published at this horizon."""
    found: dict[str, list[float]] = {}
    for (_, steps, quantity), error in protocol.published.items():
        if steps == horizon:
            found.setdefault(quantity, []).append(error)
    return {(case, horizon, q): sum(x) / len(x) for q, x in found.items()}
