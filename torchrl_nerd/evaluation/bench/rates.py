"""Control steps per second; all candidates take turns, so that noise affects all alike."""

import copy
import time
from collections.abc import Callable
from dataclasses import dataclass
from statistics import median
from typing import cast

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.collectors import Collector

from torchrl_nerd.dynamics import MujocoDynamics, NeRDDynamics
from torchrl_nerd.envs.base import SceneEnv
from torchrl_nerd.evaluation.bench.candidates import Candidate
from torchrl_nerd.evaluation.rollout_error import initial_states, scene_of
from torchrl_nerd.keys import ACTION, QPOS, QVEL, TERRAIN
from torchrl_nerd.robots import Source
from torchrl_nerd.tasks import Task

SAMPLE_SECONDS = 0.1  # one sample lasts about as long
LONGEST = 64  # control steps to the latest moment that states are taken at

Clock = Callable[[], float]
"""s: `time.perf_counter`, or `time.process_time`, which other work disturbs less."""


@dataclass(frozen=True)
class Sample:
    """Control steps of the whole batch per second: the dynamics alone, and in the env."""

    steps_per_s: float
    env_steps_per_s: float


@dataclass(frozen=True)
class RateRow:
    """Speed of one candidate with one batch.

    | field | meaning |
    |---|---|
    | ``name``, ``kind`` | of the candidate |
    | ``batch`` | trajectories stepped together |
    | ``steps_per_s`` | control steps of all of them per second, median over rounds |
    | ``env_steps_per_s`` | the same through env and collector, with random actions |
    | ``warm_up_s`` | of the first two steps, which compile where there is a compiler |
    """

    name: str
    kind: str
    batch: int
    steps_per_s: float
    env_steps_per_s: float
    warm_up_s: float


class RateBenchmark:
    """Candidates, warm, on states at random moments of passive motion.

    Args:
        candidates: whose speed is measured.
        task: its initial states, observation, reward and resets.
        batch: trajectories stepped together.
        seed: of the moments and of the envs.
        device: of all states.
    """

    def __init__(
        self,
        candidates: list[Candidate],
        task: Task,
        batch: int,
        seed: int,
        device: torch.device | str = "cpu",
    ) -> None:
        self.batch = batch
        state = mid_states(task, batch, seed).to(device)
        steppers = {c.name: _stepper(c, task, state) for c in candidates}
        envs = {c.name: _env_stepper(c, task, batch, seed, device) for c in candidates}
        self.warm_up_s = {name: _seconds(run, 2) for name, run in steppers.items()}
        self._runs = {
            name: (Runner(steppers[name]), Runner(envs[name])) for name in steppers
        }

    def round(self) -> dict[str, Sample]:
        """One sample of each candidate, by its name."""
        return {
            name: Sample(*(self.batch * runner.steps_per_s() for runner in runners))
            for name, runners in self._runs.items()
        }


def rate_rows(
    candidates: list[Candidate],
    task: Task,
    batch: int,
    rounds: int,
    seed: int,
    device: torch.device | str = "cpu",
) -> list[RateRow]:
    """Medians of a `RateBenchmark` over so many rounds; arguments as there."""
    benchmark = RateBenchmark(candidates, task, batch, seed, device)
    samples = [benchmark.round() for _ in range(rounds)]
    return [
        RateRow(
            name=c.name,
            kind=c.kind,
            batch=batch,
            steps_per_s=median(sample[c.name].steps_per_s for sample in samples),
            env_steps_per_s=median(s[c.name].env_steps_per_s for s in samples),
            warm_up_s=benchmark.warm_up_s[c.name],
        )
        for c in candidates
    ]


def mid_states(source: Source, batch: int, seed: int) -> TensorDict:
    """States ``[batch]`` at random moments of passive motion, with their terrain."""
    start, scene = initial_states(source, batch, seed), scene_of(source)
    terrain, idle = start.get(TERRAIN, None), len(scene.actuated)
    torque = torch.zeros(batch, LONGEST, idle, dtype=torch.float64)
    state = start.select(QPOS, QVEL)
    path = MujocoDynamics(scene).rollout(state, torque, terrain)
    generator = torch.Generator().manual_seed(seed)
    moment = torch.randint(LONGEST, (batch,), generator=generator)
    there = cast(TensorDict, path[torch.arange(batch), moment])
    if terrain is not None:
        there[TERRAIN] = terrain
    return there


def _stepper(
    candidate: Candidate, task: Task, state: TensorDict
) -> Callable[[int], None]:
    dynamics, terrain = candidate.make(task.scene), state.get(TERRAIN, None)
    torque = torch.zeros(len(state), len(dynamics.scene.actuated)).to(state[QPOS])
    start = state.select(QPOS, QVEL)

    def run(steps: int) -> None:
        now = start
        dynamics.reset(now)
        for _ in range(steps):
            now = dynamics.step(now, torque, terrain)

    return run


def _env_stepper(
    candidate: Candidate, task: Task, batch: int, seed: int, device: torch.device | str
) -> Callable[[int], None]:
    dynamics, there = candidate.make(task.scene), copy.copy(task)
    there.scene = dynamics.scene  # of as many substeps
    env = SceneEnv(there, dynamics, batch, seed, device)
    if isinstance(dynamics, NeRDDynamics) and dynamics.compile:
        env.compile()
    collected: dict[int, Collector] = {}

    def act(tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set(ACTION, env.action_spec.rand())

    def run(steps: int) -> None:
        if steps not in collected:  # made where it is not timed: see Runner
            collected.clear()
            collected[steps] = Collector(
                env,
                act,  # TorchRL's own random policy takes five times as long
                frames_per_batch=batch * steps,
                total_frames=-1,
                track_traj_ids=False,
                auto_register_policy_transforms=False,
            )
        next(iter(collected[steps]))

    return run


def _seconds(
    run: Callable[[int], None], steps: int, clock: Clock = time.perf_counter
) -> float:
    began = clock()
    run(steps)
    if torch.cuda.is_initialized():  # a GPU may still be at work
        torch.cuda.synchronize()
    return clock() - began


class Runner:
    """Runs for about as long as a sample lasts.

    Args:
        run: makes that many steps; two of them warm it up.
        clock: what times it.
    """

    def __init__(
        self, run: Callable[[int], None], clock: Clock = time.perf_counter
    ) -> None:
        self._run, self._clock = run, clock
        _seconds(run, 2)
        self._length = max(2, round(2 * SAMPLE_SECONDS / _seconds(run, 2, clock)))
        run(self._length)

    def steps_per_s(self) -> float:
        """Of one sample."""
        return self._length / _seconds(self._run, self._length, self._clock)


def two_in_turn(one: Runner, other: Runner, rounds: int) -> tuple[float, float, float]:
    """Steps per second of both, and of the first to the second: medians over rounds."""
    samples = [(one.steps_per_s(), other.steps_per_s()) for _ in range(rounds)]
    first, second = (median(rates) for rates in zip(*samples, strict=True))
    return first, second, median(a / b for a, b in samples)
