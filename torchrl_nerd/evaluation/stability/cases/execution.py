"""Compiled against eager, one thread against all, and a copy in another process."""

import copy
import os
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import torch
from tensordict import TensorDict
from torch import Generator, Tensor

from torchrl_nerd.dynamics import NeRDDynamics
from torchrl_nerd.evaluation.stability.case import Case, Figures
from torchrl_nerd.evaluation.stability.measures import largest
from torchrl_nerd.evaluation.stability.states import starts, uniform_torque
from torchrl_nerd.evaluation.stability.world import DynamicsWorld, World
from torchrl_nerd.keys import QVEL

ROWS, STEPS = 64, 10
COMPILED = "compiled against eager, share"
THREADS = "one thread against all, share"
PROCESS = "in another process, share"


def _run(world: World, generator: Generator, scale: float) -> Figures:
    learned = world.dynamics
    if not isinstance(learned, NeRDDynamics):
        return {COMPILED: 0.0, THREADS: 0.0, PROCESS: 0.0}  # MuJoCo is run in one way
    start = starts(world.scene, ROWS, generator)
    torque = uniform_torque(world.scene, ROWS, STEPS, generator)
    here = world.roll(start, STEPS, torque)[QVEL]
    size = 1.0 + here.abs().amax((1, 2), keepdim=True)

    def off(there: Tensor) -> float:
        return largest(((there - here) / size).abs())

    compiled = DynamicsWorld(NeRDDynamics(learned.model, compile=True))
    figures = {COMPILED: off(compiled.roll(start, STEPS, torque)[QVEL])}
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(1 if threads > 1 else os.cpu_count() or 2)
        figures[THREADS] = off(world.roll(start, STEPS, torque)[QVEL])
    finally:
        torch.set_num_threads(threads)
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        there = pool.submit(_roll, copy.deepcopy(learned), start, torque).result()
    figures[PROCESS] = off(there)
    return figures


def _roll(dynamics: NeRDDynamics, start: TensorDict, torque: Tensor) -> Tensor:
    return DynamicsWorld(dynamics).roll(start, STEPS, torque)[QVEL]


CASE = Case(
    "execution",
    "how a step is computed changes no more than the order of float32 sums",
    _run,
    lines={COMPILED: 1e-4, THREADS: 1e-4, PROCESS: 1e-4},
    needs_dynamics=True,
)
