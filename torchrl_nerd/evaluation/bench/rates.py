"""Control steps per second, all contenders in turn, so that noise hits all alike."""

import copy
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from statistics import median
from typing import cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.collectors import Collector

from torchrl_nerd.dynamics import MujocoDynamics, NeRDDynamics
from torchrl_nerd.envs.base import SceneEnv
from torchrl_nerd.evaluation.bench.contenders import Contender
from torchrl_nerd.evaluation.bench.cost import Cost
from torchrl_nerd.evaluation.rollout_error import initial_states, scene_of
from torchrl_nerd.keys import ACTION, QPOS, QVEL, TERRAIN
from torchrl_nerd.robots import Source
from torchrl_nerd.tasks import Task

VISIT = 0.1  # s: one contender's turn lasts about as long
LONGEST = 64  # control steps to the latest moment that states are taken at
MATRIX = 1024  # rows and columns of the product that measures the machine


@dataclass(frozen=True)
class Rate:
    """Speed of one contender with one batch.

    | field | meaning |
    |---|---|
    | ``steps_per_s`` | control steps of all rows per second, median over turns |
    | ``envs_per_s`` | the same through env and collector, with random actions |
    | ``warm_up_s`` | of the first two steps, which compile where there is a compiler |
    | ``matrix_share`` | of the machine's matrix rate that its matrix products reach |
    """

    steps_per_s: float
    envs_per_s: float
    warm_up_s: float
    matrix_share: float | None


@dataclass(frozen=True)
class Turn:
    """Control steps of all rows per second in one turn: alone, and through the env."""

    steps_per_s: float
    envs_per_s: float


class Race:
    """Contenders at the start, warm, from states at random moments of passive true motion.

    Args:
        contenders: who.
        task: its starts, observation, reward and resets.
        batch: rows.
        seed: of the moments and of the envs.
        device: of all states.
    """

    def __init__(
        self,
        contenders: list[Contender],
        task: Task,
        batch: int,
        seed: int,
        device: torch.device | str = "cpu",
    ) -> None:
        self.batch = batch
        state = states_on_the_way(task, batch, seed).to(device)
        steppers = {c.name: _stepper(c, task, state) for c in contenders}
        envs = {c.name: _env_stepper(c, task, batch, seed, device) for c in contenders}
        self.warm_up_s = {name: _seconds(run, 2) for name, run in steppers.items()}
        self._runs = {
            name: (Runner(steppers[name]), Runner(envs[name])) for name in steppers
        }

    def round(self) -> dict[str, Turn]:
        """One turn of each contender, by its name."""
        return {
            name: Turn(*(self.batch * runner.steps_per_s() for runner in runners))
            for name, runners in self._runs.items()
        }


def rates(
    contenders: list[Contender],
    task: Task,
    batch: int,
    rounds: int,
    seed: int,
    costs: Mapping[str, Cost],
    device: torch.device | str = "cpu",
) -> tuple[dict[str, Rate], float]:
    """Medians of a `Race` over so many rounds; arguments as there.

    Returns:
        Name -> speed, and the device's matrix rate, FLOP/s: of large float32 products
        that take turns with the contenders.
    """
    race = Race(contenders, task, batch, seed, device)
    matrix = Runner(partial(_multiply, torch.full((MATRIX, MATRIX), 0.5).to(device)))
    turns, products = [], []
    for _ in range(rounds):
        turns.append(race.round())
        products.append(2.0 * MATRIX**3 * matrix.steps_per_s())

    def share(name: str) -> float | None:
        if name not in costs:
            return None
        pairs = zip(turns, products, strict=True)
        reached = (turn[name].steps_per_s / flop_per_s for turn, flop_per_s in pairs)
        return costs[name].flop * median(reached)

    found = {
        name: Rate(
            median(turn[name].steps_per_s for turn in turns),
            median(turn[name].envs_per_s for turn in turns),
            warm_up_s,
            share(name),
        )
        for name, warm_up_s in race.warm_up_s.items()
    }
    return found, median(products)


def states_on_the_way(source: Source, batch: int, seed: int) -> TensorDict:
    """States ``[batch]`` at random moments of passive true motion, with their ground."""
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


def _multiply(matrix: Tensor, steps: int) -> None:
    product = torch.empty_like(matrix)
    for _ in range(steps):
        torch.mm(matrix, matrix, out=product)


def _stepper(
    contender: Contender, task: Task, state: TensorDict
) -> Callable[[int], None]:
    dynamics, terrain = contender.make(task.scene), state.get(TERRAIN, None)
    torque = torch.zeros(len(state), len(dynamics.scene.actuated)).to(state[QPOS])
    start = state.select(QPOS, QVEL)

    def run(steps: int) -> None:
        now = start
        dynamics.reset(now)
        for _ in range(steps):
            now = dynamics.step(now, torque, terrain)

    return run


def _env_stepper(
    contender: Contender, task: Task, batch: int, seed: int, device: torch.device | str
) -> Callable[[int], None]:
    dynamics, there = contender.make(task.scene), copy.copy(task)
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


Clock = Callable[[], float]
"""s: `time.perf_counter`, or `time.process_time`, which other work disturbs less."""


def _seconds(
    run: Callable[[int], None], steps: int, clock: Clock = time.perf_counter
) -> float:
    began = clock()
    run(steps)
    if torch.cuda.is_initialized():  # a GPU may still be at work
        torch.cuda.synchronize()
    return clock() - began


class Runner:
    """Runs for about as long as a visit lasts.

    Args:
        run: makes that many steps; two of them warm it up.
        clock: what times it.
    """

    def __init__(
        self, run: Callable[[int], None], clock: Clock = time.perf_counter
    ) -> None:
        self._run, self._clock = run, clock
        _seconds(run, 2)
        self._length = max(2, round(2 * VISIT / _seconds(run, 2, clock)))
        run(self._length)

    def steps_per_s(self) -> float:
        """Of one visit."""
        return self._length / _seconds(self._run, self._length, self._clock)


def two_in_turn(one: Runner, other: Runner, rounds: int) -> tuple[float, float, float]:
    """Steps per second of both, and of the first to the second: medians over rounds."""
    turns = [(one.steps_per_s(), other.steps_per_s()) for _ in range(rounds)]
    first, second = (median(rates) for rates in zip(*turns, strict=True))
    return first, second, median(a / b for a, b in turns)
