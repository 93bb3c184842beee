"""The race of a scene: rows of error and rate, their front, and whom to ship."""

import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from math import inf
from typing import Any

import mujoco
import torch
from tqdm import tqdm

from torchrl_nerd.evaluation.bench.contenders import contenders
from torchrl_nerd.evaluation.bench.cost import Cost, step_cost
from torchrl_nerd.evaluation.bench.errors import (
    Errors,
    chaos_floor,
    contender_errors,
    courses,
)
from torchrl_nerd.evaluation.bench.pareto import best_within, pareto_front
from torchrl_nerd.evaluation.bench.rates import Rate, rates, states_on_the_way
from torchrl_nerd.evaluation.rollout_error import ErrorSummary
from torchrl_nerd.robots import EvaluationProtocol, make_task, protocol_of
from torchrl_nerd.scenes import Scene
from torchrl_nerd.settings import expect_at_least
from torchrl_nerd.tasks import Task

COUNTED = 8  # rows of the step whose arithmetic is counted


@dataclass(frozen=True)
class BenchReport:
    """What `bench` found.

    | field | meaning |
    |---|---|
    | ``scene``, ``steps``, ``rows`` | whose rollouts, how long, how many a case |
    | ``errors`` | row -> quantity -> summary, against the finest truth |
    | ``floors`` | the same of the truth itself from starts a little off |
    | ``rates`` | batch -> row -> speed |
    | ``costs`` | learned row -> arithmetic and memory of a step |
    | ``matrix_flop_per_s`` | batch -> rate of large float32 products in the same run |
    | ``published`` | quantity -> the paper's mean error over cases, where there is one |
    | ``machine`` | processor, threads, versions |
    """

    scene: str
    steps: int
    rows: int
    errors: dict[str, Errors]
    floors: dict[str, Errors]
    rates: dict[int, dict[str, Rate]]
    costs: dict[str, Cost]
    matrix_flop_per_s: dict[int, float]
    published: dict[str, float]
    machine: dict[str, Any]

    @property
    def quantities(self) -> list[str]:
        """Names of what errs."""
        return list(next(iter(self.errors.values())))

    def front(self, batch: int, quantity: str) -> list[str]:
        """Rows that no other beats in both error and rate, the most exact first."""
        found = self.rates[batch]
        return pareto_front(
            {
                name: (errors[quantity].mean, found[name].steps_per_s)
                for name, errors in self.errors.items()
            }
        )

    def choice(self, batch: int, budget: Sequence[float]) -> str | None:
        """The fastest row within a budget of mean error, one number per quantity."""
        means = {
            name: [errors[quantity].mean for quantity in self.quantities]
            for name, errors in self.errors.items()
        }
        speeds = {name: rate.steps_per_s for name, rate in self.rates[batch].items()}
        return best_within(means, speeds, budget)

    @property
    def paper_budget(self) -> list[float] | None:
        """The paper's errors as a budget, where it published all of them."""
        found = [self.published.get(quantity) for quantity in self.quantities]
        return None if None in found else [x for x in found if x is not None]

    def figures(self) -> dict[str, Any]:
        """Everything as JSON would have it, fronts and choice included."""
        fronts = {
            str(batch): {q: self.front(batch, q) for q in self.quantities}
            for batch in self.rates
        }
        budget = self.paper_budget
        choices = {
            str(batch): self.choice(batch, budget) if budget else None
            for batch in self.rates
        }
        return asdict(self) | {"fronts": fronts, "within_paper": choices}

    @classmethod
    def from_figures(cls, figures: Mapping[str, Any]) -> "BenchReport":
        """The report whose `figures` these are, as read from JSON; null is infinity."""

        def errors(found: Mapping[str, Any]) -> dict[str, Errors]:
            return {
                name: {quantity: _summary(e) for quantity, e in row.items()}
                for name, row in found.items()
            }

        rates = {
            int(batch): {name: Rate(**rate) for name, rate in found.items()}
            for batch, found in figures["rates"].items()
        }
        flops = figures["matrix_flop_per_s"].items()
        return cls(
            scene=figures["scene"],
            steps=figures["steps"],
            rows=figures["rows"],
            errors=errors(figures["errors"]),
            floors=errors(figures["floors"]),
            rates=rates,
            costs={name: Cost(**cost) for name, cost in figures["costs"].items()},
            matrix_flop_per_s={int(batch): flop for batch, flop in flops},
            published=figures["published"],
            machine=figures["machine"],
        )


def bench(
    scene: Scene,
    batches: Sequence[int] = (1, 64, 512, 4096),
    rows: int = 256,
    rounds: int = 5,
    seed: int = 500,
    steps: int | None = None,
    is_compiling: bool = True,
    threads: int | None = None,
    device: torch.device | str = "cpu",
    quiet: bool = False,
    without: Sequence[str] = (),
    models: Sequence[str] = (),
) -> BenchReport:
    """Race MuJoCo and learned models of a scene on this machine.

    Args:
        scene: one that has a task.
        batches: rows stepped together, for the rates.
        rows: trajectories of each case, for the errors.
        rounds: turns of each contender.
        seed: of the starts.
        steps: horizon of the errors; the protocol's by default.
        is_compiling: have compiled rows.
        threads: processors to use; torch's own choice by default.
        device: of learned models and of every state whose steps are timed; MuJoCo's
            states then travel to the processor and back within its time.
        quiet: no progress bars.
        without: rows with one of these in their names take no part.
        models: see `learned_contenders`.

    Raises:
        ValueError: a scene without a task, a setting out of range, or nobody left.
    """
    expect_at_least(1, rounds=rounds, **{f"batch {b}": b for b in batches})
    expect_at_least(2, rows=rows)
    protocol = protocol_of(scene)
    task = _task_of(scene, protocol)
    if threads is not None:
        torch.set_num_threads(threads)
    threads = torch.get_num_threads()
    everyone = [
        who
        for who in contenders(scene, threads, is_compiling, device, models)
        if not any(word in who.name for word in without)
    ]
    if not everyone:
        raise ValueError(
            f"expected rows to race, got none without {', '.join(without)}"
        )
    ground = courses(protocol, rows, seed, threads, steps)
    errors = {
        who.name: contender_errors(who, ground)
        for who in tqdm(everyone, "errors", disable=quiet)
    }
    floors = chaos_floor(ground, threads, seed)
    state = states_on_the_way(task, COUNTED, seed)
    counted = {who.name: step_cost(who.make(task.scene), state) for who in everyone}
    costs = {name: cost for name, cost in counted.items() if cost is not None}
    speeds = {
        batch: rates(everyone, task, batch, rounds, seed, costs, device)
        for batch in tqdm(batches, "rates", unit=" batches", disable=quiet)
    }
    horizon = ground[0].steps
    return BenchReport(
        scene=scene.name,
        steps=horizon,
        rows=rows,
        errors=errors,
        floors=floors,
        rates={batch: found for batch, (found, _) in speeds.items()},
        costs=costs,
        matrix_flop_per_s={batch: flop for batch, (_, flop) in speeds.items()},
        published=_published(protocol, horizon),
        machine={
            "processor": platform.processor() or platform.machine(),
            "threads": threads,
            "device": _device_name(device),
            "torch": torch.__version__,
            "mujoco": mujoco.__version__,
        },
    )


def _task_of(scene: Scene, protocol: EvaluationProtocol) -> Task:
    """Whose starts, observations, rewards and resets are timed; of the suite, its own."""
    tasks = [case for case in protocol.cases.values() if isinstance(case, Task)]
    if tasks:
        return tasks[-1]
    try:
        return make_task(scene.name)
    except ValueError:
        raise ValueError(
            f"expected a robot with a task to race, such as ant or "
            f"dm_control/humanoid-run, got '{scene.name}', which has none"
        ) from None


def _summary(error: Mapping[str, Any]) -> ErrorSummary:
    found: dict[str, Any] = {k: inf if x is None else x for k, x in error.items()}
    return ErrorSummary(**found)


def _device_name(device: torch.device | str) -> str:
    """What learned models ran on: cpu, or the GPU's name."""
    here = torch.device(device)
    return torch.cuda.get_device_name(here) if here.type == "cuda" else here.type


def _published(protocol: EvaluationProtocol, horizon: int) -> dict[str, float]:
    """Means over the cases of what the paper published at this horizon."""
    found: dict[str, list[float]] = {}
    for (_, steps, quantity), error in protocol.published.items():
        if steps == horizon:
            found.setdefault(quantity, []).append(error)
    return {quantity: sum(x) / len(x) for quantity, x in found.items()}
