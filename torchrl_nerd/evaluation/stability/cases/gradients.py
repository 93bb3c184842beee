"""Gradients through 1, 32 and 100 steps, in contact where there is one."""

import torch
from tensordict import TensorDict
from torch import Generator, Tensor

from torchrl_nerd.dynamics import NeRDDynamics
from torchrl_nerd.evaluation.stability.case import Case, Figures, has_motors
from torchrl_nerd.evaluation.stability.states import starts, uniform_torque
from torchrl_nerd.evaluation.stability.world import World
from torchrl_nerd.keys import QPOS, QVEL, TERRAIN

ROWS = 8
BROKEN = "gradients that are no numbers"
OFF = "one step against finite differences, share"


def _run(world: World, generator: Generator, scale: float) -> Figures:
    learned = world.dynamics
    if not isinstance(learned, NeRDDynamics):
        return {BROKEN: 0.0, OFF: 0.0}  # MuJoCo has none
    start = starts(world.scene, ROWS, generator)
    model = learned.model
    was = model.dtype
    model.network.double()  # finite differences of float32 are noise
    try:
        return _figures(NeRDDynamics(model, differentiable=True), start, generator)
    finally:
        model.network.to(was)


def _figures(
    dynamics: NeRDDynamics, start: TensorDict, generator: Generator
) -> Figures:
    torque = uniform_torque(dynamics.scene, ROWS, 100, generator)
    broken, figures = 0, {}
    for steps in (1, 32, 100):
        push = torque[:, :1].clone().requires_grad_()
        gradient = _slope(dynamics, start, push, torque, steps)
        broken += int((~gradient.isfinite()).sum())
        figures[f"largest gradient after {steps} steps"] = float(gradient.abs().amax())
    push = torque[:, :1].clone().requires_grad_()
    gradient = _slope(dynamics, start, push, torque, 1)
    way = torch.randn(push.shape, generator=generator, dtype=torch.float64)
    step = 1e-6 * push.detach().abs().amax()
    ends = [
        _end(dynamics, start, push.detach() + s * step * way, torque, 1).sum()
        for s in (1.0, -1.0)
    ]
    slope = ((ends[0] - ends[1]) / (2.0 * step)).detach()
    expected = (gradient * way).sum()
    figures[OFF] = float((slope - expected).abs() / (expected.abs() + 1e-9))
    return {BROKEN: float(broken), **figures}


def _slope(
    dynamics: NeRDDynamics, start: TensorDict, push: Tensor, torque: Tensor, steps: int
) -> Tensor:
    """Gradient of the summed velocities with respect to the first torque."""
    end = _end(dynamics, start, push, torque, steps).sum()
    return torch.autograd.grad(end, push)[0]


def _end(
    dynamics: NeRDDynamics,
    start: TensorDict,
    push: Tensor,
    torque: Tensor,
    steps: int,
) -> Tensor:
    """Velocities after some steps of which the first is pushed."""
    state = start.select(QPOS, QVEL)
    dynamics.reset(state)
    for step in range(steps):
        now = push[:, 0] if step == 0 else torque[:, step]
        state = dynamics.step(state, now, start.get(TERRAIN, None))
    return state[QVEL]


CASE = Case(
    "gradients",
    "a differentiable step has the slope that it shows, and a long way stays finite",
    _run,
    has_motors,
    lines={BROKEN: 0.0, OFF: 1e-4},
)
