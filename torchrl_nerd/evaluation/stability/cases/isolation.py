"""One trajectory does not touch another: batches, invalid input, resets."""

import copy
from typing import cast

import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_nerd.dynamics import Dynamics
from torchrl_nerd.evaluation.stability.case import Metrics, Trial, hard_case
from torchrl_nerd.evaluation.stability.measures import relative_difference
from torchrl_nerd.evaluation.stability.stepper import DynamicsStepper
from torchrl_nerd.keys import QPOS, QVEL, TERRAIN

BATCH, NUM_SINGLE, STEPS = 4096, 8, 12
INVALID = (float("nan"), float("inf"), -float("inf"), 1e200, 5e-324)
CHANGED = "changed values in other trajectories"
SINGLE, PERMUTED = "single against batched, relative", "permuted batch, relative"
FRESH = "difference from a fresh start, relative"
COPIED = "changed values in a copy"


@hard_case(tolerances={CHANGED: 0.0})
def invalid_inputs(trial: Trial) -> Metrics:
    """An invalid value in one of 4,096 trajectories changes no bit of another."""
    count = trial.scaled(BATCH, NUM_SINGLE)
    start, torque = trial.starts(count), trial.torques(count, 3)
    expected = trial.roll(start, 3, torque)
    changed = 0
    for value in INVALID:
        index = int(torch.randint(count, (), generator=trial.generator))
        others = torch.arange(count) != index
        # an env refuses such a state in one sentence
        has_dynamics = trial.stepper.dynamics is not None
        for key in (QPOS, QVEL, "torque") if has_dynamics else ("torque",):
            bad, drive = start.clone(), torque.clone()
            (drive if key == "torque" else bad[key])[index] = value
            got = trial.roll(bad, 3, drive)
            for name in (QPOS, QVEL):
                changed += int((got[name][others] != expected[name][others]).sum())
    return {CHANGED: float(changed)}


@hard_case(
    tolerances={SINGLE: 1e-4, PERMUTED: 1e-4}, ground_truth={SINGLE: 0.0, PERMUTED: 0.0}
)
def batching(trial: Trial) -> Metrics:
    """A trajectory does not depend on its batch but for the order of float32 sums."""
    count = trial.scaled(BATCH, NUM_SINGLE)
    start, torque = trial.starts(count), trial.torques(count, 3)
    together = trial.roll(start, 3, torque)[QVEL]
    order = torch.randperm(count, generator=trial.generator)
    permuted = trial.roll(cast(TensorDict, start[order]), 3, torque[order])[QVEL]
    single = [
        trial.roll(cast(TensorDict, start[i : i + 1]), 3, torque[i : i + 1])[QVEL]
        for i in range(NUM_SINGLE)
    ]
    return {
        SINGLE: relative_difference(together[:NUM_SINGLE], torch.cat(single)),
        PERMUTED: relative_difference(together[order], permuted),
    }


@hard_case(
    tolerances={FRESH: 1e-5, COPIED: 0.0},
    ground_truth={FRESH: 1e-6, COPIED: 0.0},
    needs="dynamics",
)
def history(trial: Trial) -> Metrics:
    """Nothing of a trajectory's past outlives a reset in mid-flight."""
    dynamics = cast(Dynamics, trial.stepper.dynamics)
    start, other = trial.starts(16), trial.starts(16)
    torque = trial.torques(16, STEPS)
    is_reset = trial.uniform(16) < 0.5
    flying = cast(TensorDict, trial.roll(start, STEPS, torque)[:, -1])
    mixed = other.clone()
    for key, kept in ((QPOS, flying), (QVEL, flying), (TERRAIN, start)):
        if key in mixed.keys():
            mixed[key] = torch.where(is_reset[:, None], other[key], kept[key])
    dynamics.reset(mixed, is_reset)
    twin = copy.deepcopy(dynamics)
    fresh = DynamicsStepper(copy.deepcopy(dynamics)).roll(mixed, STEPS, torque)
    after, again = (_step_along(d, fresh, mixed, torque) for d in (dynamics, twin))
    return {
        FRESH: relative_difference(fresh[QVEL][is_reset, 1:], after[is_reset]),
        COPIED: float((after != again).sum()),
    }


def _step_along(
    dynamics: Dynamics, path: TensorDict, mixed: TensorDict, torque: Tensor
) -> Tensor:
    """Velocities ``(n, STEPS, nv)`` one step after every state of a path.

    From the path's own states, so that round-off does not grow with the steps.
    """
    terrain, after = mixed.get(TERRAIN, None), []
    for step in range(STEPS):
        now = cast(TensorDict, path[:, step]).select(QPOS, QVEL)
        after.append(dynamics.step(now, torque[:, step], terrain)[QVEL])
    return torch.stack(after, 1)
