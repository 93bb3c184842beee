"""How a step is computed: compiled, in threads, in a process, in another precision."""

import copy
import os
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import cast

import torch
from tensordict import TensorDict
from torch import Tensor, bfloat16, float32, float64

from torchrl_nerd.dynamics import NeRDDynamics
from torchrl_nerd.evaluation.rollout_error import position_errors
from torchrl_nerd.evaluation.stability.case import Metrics, Trial, hard_case
from torchrl_nerd.evaluation.stability.measures import relative_difference
from torchrl_nerd.evaluation.stability.stepper import DynamicsStepper
from torchrl_nerd.keys import QPOS, QVEL

STEPS = 10
COMPILED = "compiled against eager, relative"
THREADS = "one thread against all, relative"
PROCESS = "in another process, relative"
SINGLE = "float32 against float64 after 1 step"
HALF = "bfloat16 against float64 after 1 step"


@hard_case(tolerances={COMPILED: 1e-4, THREADS: 1e-4, PROCESS: 1e-4}, needs="model")
def execution(trial: Trial) -> Metrics:
    """Compilation, threads and processes change no more than the order of float32 sums."""
    start, torque = trial.starts(64), trial.torques(64, STEPS)
    here = trial.roll(start, STEPS, torque)[QVEL]
    compiled = _roll(NeRDDynamics(trial.model, compile=True), start, torque)
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(1 if threads > 1 else os.cpu_count() or 2)
        in_threads = trial.roll(start, STEPS, torque)[QVEL]
    finally:
        torch.set_num_threads(threads)
    dynamics = copy.deepcopy(cast(NeRDDynamics, trial.stepper.dynamics))
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        in_process = pool.submit(_roll, dynamics, start, torque).result()
    return {
        COMPILED: relative_difference(here, compiled),
        THREADS: relative_difference(here, in_threads),
        PROCESS: relative_difference(here, in_process),
    }


def _roll(dynamics: NeRDDynamics, start: TensorDict, torque: Tensor) -> Tensor:
    return DynamicsStepper(dynamics).roll(start, STEPS, torque)[QVEL]


@hard_case(tolerances={SINGLE: 1e-5}, needs="model")
def precision(trial: Trial) -> Metrics:
    """A network in float32 steps as in float64; bfloat16 is measured."""
    start, paths = trial.starts(32), {}
    for dtype in (float64, float32, bfloat16):
        model = copy.deepcopy(trial.model)
        model.network.to(dtype)
        paths[dtype] = DynamicsStepper(NeRDDynamics(model)).roll(start, 100)[QPOS]
    metrics = {}
    for dtype, name in ((float32, SINGLE), (bfloat16, HALF)):
        errors = position_errors(trial.scene, paths[float64], paths[dtype]).values()
        metrics[name] = max(float(e[:, 1].mean()) for e in errors)
        later = name.replace("1 step", "100 steps")
        metrics[later] = max(float(e[:, -1].mean()) for e in errors)
    return metrics
