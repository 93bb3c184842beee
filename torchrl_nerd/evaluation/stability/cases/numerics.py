"""Long runs, extreme torques, invalid input, batches, gradients."""

from typing import cast

import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_nerd.dynamics import NeRDDynamics
from torchrl_nerd.evaluation.stability.case import (
    Metrics,
    Trial,
    hard_case,
    has_motors,
    norm,
    relative_difference,
)
from torchrl_nerd.keys import QPOS, QVEL, TERRAIN

NON_FINITE = "non-finite trajectories"
SPEED = "largest speed, m/s or rad/s"
LEAP = "distance beyond the speed bound times time, m"
KEPT = 1000  # states of a long rollout
ROUNDING = 1e-6
BATCH, NUM_SINGLE = 4096, 8
INVALID = (float("nan"), float("inf"), -float("inf"), 1e200, 5e-324)
CHANGED = "changed values in other trajectories"
SINGLE, PERMUTED = "single against batched, relative", "permuted batch, relative"
NON_FINITE_GRADIENTS = "non-finite gradients"
ERROR = "one step against finite differences, relative"
SLOW = 0.1  # of the training speeds


@hard_case({NON_FINITE: 0.0, SPEED: 1e3}, {}, has_motors)
def torques(trial: Trial) -> Metrics:
    """Zero, largest, 1000-fold and alternating torques leave every state finite."""
    high = torch.tensor(trial.scene.sampling.torque, dtype=torch.float64)
    sign = torch.tensor([1.0, -1.0], dtype=torch.float64)[:, None]
    zero, full = torch.zeros(2, len(high)).double(), high.expand(2, -1)
    kinds = torch.stack(
        (zero, full, 1000.0 * full, sign * full)
    )  # (4, 2, num_actuated)
    start = trial.starts(16)
    steps = trial.scaled(1000, 20)
    path = trial.roll(start, steps, kinds.repeat(4, 1, 1), steps // 20)
    return _finiteness(path)


@hard_case({NON_FINITE: 0.0, LEAP: 0.0}, {})
def horizon(trial: Trial) -> Metrics:
    """Over 100,000 steps states stay finite and move no farther than their speed allows."""
    scene, steps = trial.scene, trial.scaled(100_000, KEPT) // KEPT * KEPT
    path = trial.roll(trial.starts(8), steps, trial.torques(8, 512), steps // KEPT)
    metrics = _finiteness(path) | {LEAP: 0.0}
    if scene.base.is_floating and isinstance(trial.dynamics, NeRDDynamics):
        q, v = scene.base.qpos_address, scene.base.dof_address
        moved = path[QPOS][..., q : q + 3].diff(dim=1)  # (n, KEPT, 3)
        bound = float(trial.model.training_range.speed[v])
        seconds = scene.control_step * (steps // KEPT)
        beyond = norm(moved) - (1.0 + ROUNDING) * bound * seconds
        metrics[LEAP] = float(beyond.clamp(min=0.0).amax())
    return metrics


def _finiteness(path: TensorDict) -> Metrics:
    """How many trajectories are not finite, and the largest speed of the others."""
    state = torch.cat((path[QPOS], path[QVEL]), -1)  # (n, steps, nq + nv)
    is_finite = state.isfinite().flatten(1).all(1)
    speed = path[QVEL].abs().nan_to_num(0.0, 0.0, 0.0).amax()
    return {NON_FINITE: float((~is_finite).sum()), SPEED: float(speed)}


@hard_case({CHANGED: 0.0})
def invalid_inputs(trial: Trial) -> Metrics:
    """An invalid value in one of 4,096 trajectories changes no bit of another."""
    count = trial.scaled(BATCH, NUM_SINGLE)
    start, torque = trial.starts(count), trial.torques(count, 3)
    expected = trial.roll(start, 3, torque)
    changed = 0
    for value in INVALID:
        index = int(torch.randint(count, (), generator=trial.generator))
        others = torch.arange(count) != index
        for key in (QPOS, QVEL, "torque"):
            bad, drive = start.clone(), torque.clone()
            (drive if key == "torque" else bad[key])[index] = value
            got = trial.roll(bad, 3, drive)
            for name in (QPOS, QVEL):
                changed += int((got[name][others] != expected[name][others]).sum())
    return {CHANGED: float(changed)}


@hard_case({SINGLE: 1e-4, PERMUTED: 1e-4}, {SINGLE: 0.0, PERMUTED: 0.0})
def batching(trial: Trial) -> Metrics:
    """A trajectory does not depend on its batch but for the order of float32 sums."""
    count = trial.scaled(BATCH, NUM_SINGLE)
    start, torque = trial.starts(count), trial.torques(count, 3)

    def velocities(index: Tensor) -> Tensor:
        return trial.roll(cast(TensorDict, start[index]), 3, torque[index])[QVEL]

    together = velocities(torch.arange(count))  # (count, 4, nv)
    order = torch.randperm(count, generator=trial.generator)
    single = torch.cat([velocities(i) for i in torch.arange(NUM_SINGLE).split(1)])
    return {
        SINGLE: relative_difference(together[:NUM_SINGLE], single),
        PERMUTED: relative_difference(together[order], velocities(order)),
    }


@hard_case({NON_FINITE_GRADIENTS: 0.0, ERROR: 1e-4}, needs_model=True)
def gradients(trial: Trial) -> Metrics:
    """Gradients equal finite differences and stay finite over 100 steps."""
    start = trial.starts(8)
    if trial.scene.base.is_floating:  # on the ground, moving slowly
        lying = trial.settled(8)
        lying[QVEL] += SLOW * start[QVEL][: len(lying)]
        start = lying
    torque = trial.torques(len(start), 100)
    model, dtype = trial.model, trial.model.dtype
    model.network.double()  # finite differences of float32 are noise
    dynamics = NeRDDynamics(model, differentiable=True)

    def end(first: list[Tensor], steps: int) -> Tensor:
        """Sum of the final velocities, from first velocities and torques."""
        state = start.select(QPOS).set(QVEL, first[0])
        dynamics.reset(state)
        for now in (first[1], *torque[:, 1:steps].unbind(1)):
            state = dynamics.step(state, now, start.get(TERRAIN, None))
        return state[QVEL].sum()

    def gradient(steps: int) -> tuple[Tensor, ...]:
        leaves = [x.clone().requires_grad_() for x in first]
        return torch.autograd.grad(
            end(leaves, steps), leaves, allow_unused=True, materialize_grads=True
        )

    first, metrics = [start[QVEL], torque[:, 0]], {NON_FINITE_GRADIENTS: 0.0}
    try:
        for steps in (1, 32, 100):
            found = gradient(steps)
            count = sum(float((~g.isfinite()).sum()) for g in found)
            metrics[NON_FINITE_GRADIENTS] += count
            size = max(float(g.abs().amax()) for g in found if g.numel())
            metrics[f"largest gradient after {steps} steps"] = size
        shift = [1e-6 * (1.0 + x.abs().amax(0)) * trial.normal(*x.shape) for x in first]
        pairs = list(zip(first, shift, strict=True))
        # central difference along one random direction
        ahead, behind = (end([x + s * d for x, d in pairs], 1) for s in (1.0, -1.0))
        central = 0.5 * (ahead - behind).detach()
        along = [(g * d).sum() for g, d in zip(gradient(1), shift, strict=True)]
        expected = torch.stack(along).sum()
        metrics[ERROR] = float((central - expected).abs() / (expected.abs() + 1e-15))
    finally:
        model.network.to(dtype)
    return metrics
