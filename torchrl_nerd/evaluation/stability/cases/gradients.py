"""Gradients through 1, 32 and 100 steps, in contact where there is a ground."""

import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_nerd.dynamics import NeRDDynamics
from torchrl_nerd.evaluation.stability.case import (
    Metrics,
    Trial,
    hard_case,
    has_floating_base,
)
from torchrl_nerd.keys import QPOS, QVEL, TERRAIN

SLOW = 0.1  # of the training speeds
NON_FINITE = "non-finite gradients"
ERROR = "one step against finite differences, relative"


@hard_case(tolerances={NON_FINITE: 0.0, ERROR: 1e-4}, needs="model")
def gradients(trial: Trial) -> Metrics:
    """Gradients equal finite differences and stay finite over 100 steps."""
    model, dtype = trial.model, trial.model.dtype
    model.network.double()  # finite differences of float32 are noise
    try:
        dynamics = NeRDDynamics(model, differentiable=True)
        return _measure(dynamics, _start(trial), trial)
    finally:
        model.network.to(dtype)


def _start(trial: Trial) -> TensorDict:
    """On the ground where the robot can lie there, moving slowly."""
    start = trial.starts(8)
    if not has_floating_base(trial.scene):
        return start
    lying = trial.settled(8)
    lying[QVEL] += SLOW * start[QVEL][: len(lying)]
    return lying


def _measure(dynamics: NeRDDynamics, start: TensorDict, trial: Trial) -> Metrics:
    torque = trial.torques(len(start), 100)
    inputs = start[QVEL], torque[:, 0]
    metrics: Metrics = {NON_FINITE: 0.0}
    for steps in (1, 32, 100):
        found = _gradients(dynamics, start, inputs, torque[:, 1:steps])
        metrics[NON_FINITE] += sum(float((~g.isfinite()).sum()) for g in found)
        sizes = [float(g.abs().amax()) for g in found if g.numel()]
        metrics[f"largest gradient after {steps} steps"] = max(sizes)
    step = [1e-6 * (1.0 + x.abs().amax(0)) * trial.normal(*x.shape) for x in inputs]
    ahead, behind = (
        _end(dynamics, start, [x + s * d for x, d in zip(inputs, step, strict=True)])
        for s in (1.0, -1.0)
    )
    central = 0.5 * (ahead - behind).sum().detach()
    pairs = zip(_gradients(dynamics, start, inputs, torque[:, :0]), step, strict=True)
    expected = torch.stack([(g * d).sum() for g, d in pairs]).sum()
    error = (central - expected).abs() / (expected.abs() + 1e-15)
    return metrics | {ERROR: float(error)}


def _gradients(
    dynamics: NeRDDynamics,
    start: TensorDict,
    inputs: tuple[Tensor, Tensor],
    later: Tensor,
) -> tuple[Tensor, ...]:
    """Of the summed final velocities by ``inputs``."""
    first = [x.clone().requires_grad_() for x in inputs]
    end = _end(dynamics, start, first, later).sum()
    return torch.autograd.grad(end, first, allow_unused=True, materialize_grads=True)


def _end(
    dynamics: NeRDDynamics,
    start: TensorDict,
    first: list[Tensor],
    later: Tensor | None = None,
) -> Tensor:
    """Final velocities from first velocities and torques, and the later torques."""
    qvel, torque = first
    state = start.select(QPOS).set(QVEL, qvel)
    dynamics.reset(state)
    for now in (torque, *(() if later is None else later.unbind(1))):
        state = dynamics.step(state, now, start.get(TERRAIN, None))
    return state[QVEL]
