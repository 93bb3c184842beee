"""Control steps per second; all candidates take turns, so that noise affects all alike."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from statistics import median
from typing import cast

import torch
from tensordict import TensorDict

from torchrl_nerd.dynamics import Dynamics, MujocoDynamics
from torchrl_nerd.evaluation.bench.candidates import Candidate
from torchrl_nerd.evaluation.rollout_error import (
    initial_states,
    rollout,
    scene_of,
    states_of,
)
from torchrl_nerd.keys import TERRAIN
from torchrl_nerd.robots import Source

SAMPLE_SECONDS = 0.1  # one sample lasts about as long
MAX_STEP = 64  # control steps to the latest moment that states are taken at


@dataclass(frozen=True)
class RateRow:
    """Speed of one candidate with one batch."""

    name: str
    kind: str
    batch: int  # trajectories stepped together
    steps_per_s: float  # control steps of all of them per second, median over rounds
    warm_up_s: float  # of the first two steps, which compile where there is a compiler


def rate_rows(
    candidates: list[Candidate],
    source: Source,
    batch: int,
    rounds: int,
    seed: int,
    device: torch.device | str = "cpu",
) -> list[RateRow]:
    """Medians over ``rounds``, in each of which every candidate has one sample.

    All start from `mid_states` ``[batch]`` on ``device``.
    """
    state, scene = mid_states(source, batch, seed).to(device), scene_of(source)
    runners = [Runner(stepper(c.make(scene), state)) for c in candidates]
    samples = [[runner.steps_per_s() for runner in runners] for _ in range(rounds)]
    return [
        RateRow(c.name, c.kind, batch, batch * median(rates), runner.warm_up_s)
        for c, runner, *rates in zip(candidates, runners, *samples, strict=True)
    ]


def mid_states(source: Source, batch: int, seed: int) -> TensorDict:
    """States ``[batch]`` at random moments of passive motion, with their terrain."""
    start = initial_states(source, batch, seed)
    path = rollout(MujocoDynamics(scene_of(source)), start, MAX_STEP)
    generator = torch.Generator().manual_seed(seed)
    moment = 1 + torch.randint(MAX_STEP, (batch,), generator=generator)
    state = cast(TensorDict, path[torch.arange(batch), moment])  # [batch]
    return state.update(start.select(TERRAIN, strict=False))


def stepper(dynamics: Dynamics, state: TensorDict) -> Callable[[int], None]:
    """A function that makes so many steps from ``state`` ``[batch]``, without torque."""

    def run(steps: int) -> None:
        for _ in states_of(dynamics, state, steps):
            pass

    return run


class Runner:
    """Runs for about as long as a sample lasts.

    ``run`` makes so many steps; two of them, ``warm_up_s`` long, warm it up. ``clock``:
    `time.perf_counter`, or `time.process_time`, which other work disturbs less.
    """

    def __init__(
        self, run: Callable[[int], None], clock: Callable[[], float] = time.perf_counter
    ) -> None:
        self._run, self._clock = run, clock
        self.warm_up_s = self._seconds(2)
        self._length = max(2, round(2 * SAMPLE_SECONDS / self._seconds(2)))
        run(self._length)

    def _seconds(self, steps: int) -> float:
        began = self._clock()
        self._run(steps)
        if torch.cuda.is_initialized():  # a GPU may still be at work
            torch.cuda.synchronize()
        return self._clock() - began

    def steps_per_s(self) -> float:
        """Of one sample."""
        return self._length / self._seconds(self._length)
