"""A hard case: a function that measures physics of known outcome against its limits."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import inf
from typing import Any
from zlib import crc32

import torch
from tensordict import TensorDict
from torch import Generator, Tensor

from torchrl_nerd.dynamics import Dynamics, MujocoDynamics, NeRDDynamics
from torchrl_nerd.evaluation.position_error import position_errors
from torchrl_nerd.evaluation.rollout_error import rollout
from torchrl_nerd.evaluation.stability.states import (
    clear_of_ground,
    sample_states,
    settled_states,
)
from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.sampling import sample_commands


@dataclass(frozen=True)
class Metric:
    """One number that a case measured in a dynamics."""

    name: str  # with its unit
    value: float
    limit: float = inf  # largest allowed value; infinite: the number is for information
    mujoco_limit: float | None = None  # that validates the case; None: ``limit``

    def passes(self, in_mujoco: bool = False) -> bool:
        """Whether it is within the limit, as NaN is not, or has none."""
        limit = self.mujoco_limit if in_mujoco else None
        limit = self.limit if limit is None else limit
        return limit == inf or self.value <= limit


@dataclass(frozen=True)
class Trial:
    """One run of a case: what is stepped, and the random numbers."""

    dynamics: Dynamics
    generator: Generator  # of starts and torques
    scale: float = 1.0  # fraction of long rollouts and large batches, in (0, 1]

    @property
    def scene(self) -> Scene:
        """The robot."""
        return self.dynamics.scene

    @property
    def model(self) -> NeRD:
        """The model, for cases that need one."""
        assert isinstance(self.dynamics, NeRDDynamics)
        return self.dynamics.model

    def roll(self, start: TensorDict, steps: int, *how: Any, **more: Any) -> TensorDict:
        """`rollout` in the dynamics under test."""
        return rollout(self.dynamics, start, steps, *how, **more)

    def roll_exactly(
        self, start: TensorDict, steps: int, *how: Any, **more: Any
    ) -> TensorDict:
        """`rollout` in MuJoCo."""
        return rollout(MujocoDynamics(self.scene), start, steps, *how, **more)

    def scaled(self, count: int, least: int) -> int:
        """A number of steps or trajectories times the scale."""
        return max(least, round(self.scale * count))

    def starts(self, count: int) -> TensorDict:
        """See `sample_states`."""
        return sample_states(self.scene, count, self.generator)

    def settled(self, count: int) -> TensorDict:
        """See `settled_states`."""
        return settled_states(self.scene, count).clone()

    def in_air(self, count: int, speed: float) -> TensorDict:
        """States ``[count]`` that nothing touches, at a fraction of the training speeds."""
        start = clear_of_ground(self.scene, self.starts(count))
        return start.set(QVEL, speed * start[QVEL])

    def commands(self, count: int, steps: int) -> Tensor:
        """Torques, or servos' controls, in the training range, ``(count, steps, m)``."""
        scale = torch.ones(count, 1, dtype=torch.float64)
        return sample_commands(self.scene.sampling, scale, steps, self.generator)

    def normal(self, *shape: int) -> Tensor:
        """Standard normal numbers, float64."""
        return torch.randn(shape, generator=self.generator, dtype=torch.float64)

    def difference(self, path: TensorDict, other: TensorDict) -> Tensor:
        """Largest difference of all position quantities, m or rad, ``(n, steps)``."""
        errors = position_errors(self.scene, path[QPOS], other[QPOS])
        return torch.stack(list(errors.values())).amax(0)  # over quantities


Run = Callable[[Trial], Iterator[Metric]]
"""Measures one trial; its docstring says what should happen, and why."""


@dataclass(frozen=True)
class Case:
    """One hard case: its `Run`, the robots it applies to, whether it needs a network."""

    run: Run
    applies: Callable[[Scene], bool] = lambda scene: True
    needs_model: bool = False

    @property
    def name(self) -> str:
        """Of the function."""
        return self.run.__name__

    def supports(self, dynamics: Dynamics) -> bool:
        """Whether the case can run on it."""
        fits = isinstance(dynamics, NeRDDynamics) or not self.needs_model
        return fits and self.applies(dynamics.scene)


CASES: dict[str, Case] = {}
"""Every case by name, filled by `hard_case`."""


def hard_case(
    applies: Callable[[Scene], bool] = lambda scene: True, needs_model: bool = False
) -> Callable[[Run], Run]:
    """Register a function as the case of its name; see `Case` for the arguments."""

    def register(run: Run) -> Run:
        CASES[run.__name__] = Case(run, applies, needs_model)
        return run

    return register


@dataclass(frozen=True)
class Result:
    """One case in both dynamics."""

    case: str
    physics: str  # what should happen
    ground_truth: dict[str, float]  # metrics; none where a model is needed
    tested: dict[str, float]
    ground_truth_passes: bool  # whether all are within their limits
    passes: bool
    tolerances: dict[str, float]  # limits of the dynamics under test
    seconds: float  # for both
    skipped: str = ""  # why nothing was measured


def run_cases(
    tested: Dynamics, cases: list[Case], seed: int = 0, scale: float = 1.0
) -> Iterator[Result]:
    """Every case that applies, in MuJoCo and in the dynamics under test.

    Of ``seed`` each case has random numbers of its own, the same in both.
    """
    for case in cases:
        if not case.supports(tested):
            continue
        began, found = time.monotonic(), []
        skipped = ""
        for dynamics in (MujocoDynamics(tested.scene), tested):
            stream = Generator().manual_seed(crc32(case.name.encode(), seed))
            trial = Trial(dynamics, stream, scale)
            try:
                found.append(list(case.run(trial)) if case.supports(dynamics) else [])
            except ValueError as error:  # a robot that never rests, for one
                found, skipped = [[], []], str(error)
                break
        exact, mine = found
        yield Result(
            case=case.name,
            physics=" ".join((case.run.__doc__ or "").split()),
            ground_truth={m.name: m.value for m in exact},
            tested={m.name: m.value for m in mine},
            ground_truth_passes=all(m.passes(in_mujoco=True) for m in exact),
            passes=all(m.passes() for m in mine),
            tolerances={m.name: m.limit for m in mine if m.limit < inf},
            seconds=round(time.monotonic() - began, 1),
            skipped=skipped,
        )


def as_table(results: list[Result], kind: str = "tested") -> str:
    """Markdown: one line per metric; ``kind`` heads the tested dynamics' column."""
    lines = [f"| case | metric | MuJoCo | {kind} | tolerance | |", "|---" * 6 + "|"]
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


def has_floating_base(scene: Scene) -> bool:
    """Whether the base moves freely."""
    return scene.base.is_floating


def can_land(scene: Scene) -> bool:
    """Whether the base moves freely over a ground."""
    return scene.base.is_floating and scene.terrain is not None


def largest(value: Tensor) -> float:
    """The largest entry; infinity if any is not finite, or there is none."""
    is_valid = value.numel() and value.isfinite().all()
    return float(value.max()) if is_valid else inf


def norm(x: Tensor) -> Tensor:
    """Length of vectors ``(*batch, D)``."""
    return torch.linalg.vector_norm(x, dim=-1)
