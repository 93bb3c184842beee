"""Control steps per second, all contenders in turn, so that noise hits all alike."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from statistics import median
from typing import cast

import torch
from tensordict import TensorDict
from torchrl.collectors import Collector

from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.envs import make_env
from torchrl_nerd.evaluation.bench.contenders import Contender
from torchrl_nerd.evaluation.rollout_error import initial_states
from torchrl_nerd.keys import QPOS, QVEL, TERRAIN
from torchrl_nerd.tasks import Task

VISIT = 0.1  # s: one contender's turn lasts about as long
LONGEST = 64  # control steps to the latest moment that states are taken at


@dataclass(frozen=True)
class Rate:
    """Speed of one contender with one batch.

    | field | meaning |
    |---|---|
    | ``steps_per_s`` | control steps of all rows per second, median over turns |
    | ``envs_per_s`` | the same through env and collector, with random actions |
    | ``warm_up_s`` | of the first two steps, which compile where there is a compiler |
    """

    steps_per_s: float
    envs_per_s: float
    warm_up_s: float


def rates(
    contenders: list[Contender], task: Task, batch: int, rounds: int, seed: int
) -> dict[str, Rate]:
    """Race from states at random moments of passive true motion.

    Args:
        contenders: who.
        task: its starts, observation, reward and resets.
        batch: rows.
        rounds: turns of each.
        seed: of the moments and of the envs.
    """
    state = states_on_the_way(task, batch, seed)
    steppers = {c.name: _stepper(c, task, state) for c in contenders}
    envs = {c.name: _env_stepper(c, task, batch, seed) for c in contenders}
    warm = {name: _seconds(run, 2) for name, run in steppers.items()}
    alone, whole = (_race(runs, rounds) for runs in (steppers, envs))
    return {
        name: Rate(batch * alone[name], batch * whole[name], warm[name])
        for name in warm
    }


def states_on_the_way(task: Task, batch: int, seed: int) -> TensorDict:
    """States ``[batch]`` at random moments of passive true motion, with their ground."""
    start = initial_states(task, batch, seed)
    terrain, idle = start.get(TERRAIN, None), len(task.scene.actuated)
    torque = torch.zeros(batch, LONGEST, idle, dtype=torch.float64)
    state = start.select(QPOS, QVEL)
    path = MujocoDynamics(task.scene).rollout(state, torque, terrain)
    generator = torch.Generator().manual_seed(seed)
    moment = torch.randint(LONGEST, (batch,), generator=generator)
    there = cast(TensorDict, path[torch.arange(batch), moment])
    if terrain is not None:
        there[TERRAIN] = terrain
    return there


def _stepper(
    contender: Contender, task: Task, state: TensorDict
) -> Callable[[int], None]:
    dynamics, terrain = contender.make(task.scene), state.get(TERRAIN, None)
    torque = torch.zeros(len(state), len(dynamics.scene.actuated)).double()
    start = state.select(QPOS, QVEL)

    def run(steps: int) -> None:
        now = start
        dynamics.reset(now)
        for _ in range(steps):
            now = dynamics.step(now, torque, terrain)

    return run


def _env_stepper(
    contender: Contender, task: Task, batch: int, seed: int
) -> Callable[[int], None]:
    env = make_env(task, dynamics="mujoco", num_envs=batch, seed=seed)
    env.dynamics = contender.make(task.scene)
    collected: dict[int, Collector] = {}

    def run(steps: int) -> None:
        if steps not in collected:  # made where it is not timed: see _race
            collected.clear()
            collected[steps] = Collector(
                env,
                None,
                frames_per_batch=batch * steps,
                total_frames=-1,
                track_traj_ids=False,
            )
        next(iter(collected[steps]))

    return run


def _seconds(run: Callable[[int], None], steps: int) -> float:
    began = time.perf_counter()
    run(steps)
    return time.perf_counter() - began


def _race(runs: dict[str, Callable[[int], None]], rounds: int) -> dict[str, float]:
    """Steps per second of each, median over turns."""
    lengths, times = {}, {name: [] for name in runs}
    for name, run in runs.items():
        _seconds(run, 2)
        lengths[name] = max(2, round(2 * VISIT / _seconds(run, 2)))
        run(lengths[name])
    for _ in range(rounds):
        for name, run in runs.items():
            times[name].append(_seconds(run, lengths[name]))
    return {name: lengths[name] / median(seconds) for name, seconds in times.items()}
