"""Open-loop errors of all candidates, from equal initial states and actions."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite

import torch
from tensordict import TensorDict
from torch import Tensor
from tqdm import tqdm

from torchrl_nerd.dynamics import Dynamics, MujocoDynamics
from torchrl_nerd.evaluation.bench.candidates import Candidate, mujoco_name
from torchrl_nerd.evaluation.position_error import Errors, position_errors, unit_of
from torchrl_nerd.evaluation.rollout_error import (
    Drive,
    action_drive,
    initial_states,
    motion_before,
    open_loop,
    scene_of,
    summarize,
)
from torchrl_nerd.evaluation.tables import text_table
from torchrl_nerd.geometry.manifold import integrate_pos
from torchrl_nerd.keys import QPOS
from torchrl_nerd.robots import EvaluationProtocol, Source
from torchrl_nerd.scenes import Scene
from torchrl_nerd.seeds import fold_in

DRIVEN = "driven"
"""The case of uniform random actions, beside the passive ones."""
GROUND_TRUTH = "ground truth"
PAPER = "paper (NeRD)"
QUANTITIES = 3  # side by side: more do not fit on a line


@dataclass(frozen=True)
class EvaluationSet:
    """One case: what every candidate starts from, is driven by and is measured against."""

    case: str
    source: Source  # whose initial states and controller
    start: TensorDict  # initial states, [n]
    drive: Drive  # see `states_of`
    solver: str  # of the ground truth, see `mujoco_name`
    ground_truth: Tensor  # positions after each step, (n, steps, nq)
    history: TensorDict | None = None  # motion [n, T] seen before by every candidate

    @property
    def scene(self) -> Scene:
        """The robot and its terrain."""
        return scene_of(self.source)

    def errors(self, dynamics: Dynamics, start: TensorDict | None = None) -> Errors:
        """Error at every step from these initial states or the set's; NaN: it diverges."""
        start = self.start if start is None else start
        steps = self.ground_truth.shape[1]
        path = open_loop(dynamics, start, steps, self.drive, True, self.history)
        return position_errors(self.scene, self.ground_truth, path)

    def candidate_errors(self, candidate: Candidate) -> Errors:
        """The same of a candidate: 0 by definition of the ground truth itself."""
        if candidate.name != self.solver:
            return self.errors(candidate.make(self.scene))
        path = self.ground_truth
        return {k: 0.0 * e for k, e in position_errors(self.scene, path, path).items()}

    def perturbed(self, size: float, seed: int) -> TensorDict:
        """The initial states with ``size`` (m, rad) times a normal number added to each."""
        layout, start = self.scene.layout, self.start.clone()
        # numbers that neither the starts nor random actions have
        shape, generator = (len(start), layout.nv), fold_in(seed, 2)
        noise = torch.randn(shape, dtype=torch.float64, generator=generator)  # (n, nv)
        start[QPOS] = integrate_pos(layout, start[QPOS], size * noise.to(start[QPOS]))
        return start


def cases_of(protocol: EvaluationProtocol) -> Iterator[tuple[str, Source, bool]]:
    """Name, source and whether actions are random, of every case of a protocol.

    A robot with actuators gets a driven case after its own, unless it has one.
    """
    for case, source in protocol.cases.items():
        yield case, source, case in protocol.random_actions
    last = list(protocol.cases.values())[-1]
    if scene_of(last).controller.num_actions and not protocol.random_actions:
        yield DRIVEN, last, True


def evaluation_set(
    case: str,
    source: Source,
    is_driven: bool,
    ground_truth: Callable[[Scene], MujocoDynamics],
    num_trajectories: int,
    steps: int,
    seed: int,
    device: torch.device | str = "cpu",
    history: int = 0,
) -> EvaluationSet:
    """The set of one case, of which the ground truth makes the trajectories.

    They begin after ``history`` steps of it, which all candidates see.
    """
    start = initial_states(source, num_trajectories, seed).to(device)
    drive = action_drive(source, num_trajectories, history + steps, seed, is_driven)
    exact = ground_truth(scene_of(source))
    start, seen, drive = motion_before(exact, start, history, drive)
    path = open_loop(exact, start, steps, drive, history=seen)
    solver = mujoco_name(exact.scene)
    return EvaluationSet(case, source, start, drive, solver, path, seen)


def measure(
    sets: Sequence[EvaluationSet],
    candidates: Sequence[Candidate],
    title: str = "errors",
    quiet: bool = True,
) -> dict[tuple[str, str], Errors]:
    """Errors over all sets together, by name and kind of the candidate."""
    found = {}
    for c in tqdm(candidates, title, leave=False, disable=quiet):
        kind = GROUND_TRUTH if c.name == sets[0].solver else c.kind
        found[c.name, kind] = together([each.candidate_errors(c) for each in sets])
    return found


def together(parts: Sequence[Errors]) -> Errors:
    """Errors of several sets as one."""
    return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}


@dataclass(frozen=True)
class ErrorRow:
    """One candidate, one case, one horizon, one quantity; see `ErrorSummary`."""

    case: str
    steps: int
    name: str  # of the candidate
    kind: str
    quantity: str
    unit: str
    mean: float
    interval: float | None = None  # None: not published
    final: float | None = None
    p95: float | None = None


def error_rows(
    scene: Scene,
    case: str,
    horizon: int,
    errors: Mapping[tuple[str, str], Errors],
    published: Mapping[tuple[str, int, str], float],
) -> list[ErrorRow]:
    """Rows of one case and horizon: every candidate in its order, the paper last.

    ``errors``: (name, kind) -> errors at every step, which are averaged over the horizon.
    ``published``: (case, horizon, quantity) -> the paper's mean error, m or rad.
    """
    rows, about = [], (case, horizon)
    for (name, kind), by_name in errors.items():
        for quantity, error in summarize(scene, by_name, horizon).items():
            rows.append(ErrorRow(*about, name, kind, quantity, **vars(error)))
    for quantity in dict.fromkeys(row.quantity for row in rows):
        mean = published.get((*about, quantity))
        if mean is not None:
            unit = unit_of(scene, quantity)
            rows.append(ErrorRow(*about, PAPER, "published", quantity, unit, mean))
    return rows


def error_table(
    rows: Sequence[ErrorRow], rates: Mapping[str, Mapping[str, float]] | None = None
) -> str:
    """Text of the rows of one case and horizon: a line for every candidate.

    ``rates``: column -> name -> control steps per second.
    """
    rates = rates or {}
    quantities = list(dict.fromkeys((row.quantity, row.unit) for row in rows))
    numbers = {(x.name, x.quantity): (x.mean, x.final, x.p95) for x in rows}
    missing = None, None, None
    tables = []
    for first in range(0, len(quantities), QUANTITIES):
        shown = quantities[first : first + QUANTITIES]
        titles = [title for q, unit in shown for title in (f"{q} ({unit})", "", "")]
        head = ["name", "kind", *("mean", "final", "p95") * len(shown), *rates]
        body = []
        for name, kind in dict.fromkeys((row.name, row.kind) for row in rows):
            found = (numbers.get((name, q), missing) for q, _ in shown)
            cells = [error_text(x) for each in found for x in each]
            speeds = [speed.get(name) for speed in rates.values()]
            cells += ["-" if x is None else f"{x:,.0f}" for x in speeds]
            body.append([name, kind, *cells])
        tables.append(text_table(head, body, titles))
    return "\n\n".join(tables)


def error_text(value: float | None) -> str:
    """Three digits; an error that is not finite is of a rollout that diverges."""
    if value is None:
        return "-"
    return f"{value:.3g}" if isfinite(value) else "diverges"
