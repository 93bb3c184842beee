"""Gradients through 1, 32 and 100 steps, in contact where there is one."""

import torch
from tensordict import TensorDict
from torch import Generator, Tensor

from torchrl_nerd.dynamics import NeRDDynamics
from torchrl_nerd.evaluation.stability.case import Case, Figures, has_floating_base
from torchrl_nerd.evaluation.stability.states import (
    settled,
    starts,
    uniform_torque,
)
from torchrl_nerd.evaluation.stability.world import World
from torchrl_nerd.keys import QPOS, QVEL, TERRAIN
from torchrl_nerd.scenes import Scene

ROWS = 8
SLOW = 0.1  # of the training speeds
BROKEN = "gradients that are no numbers"
OFF = "one step against finite differences, share"


def _run(world: World, generator: Generator, scale: float) -> Figures:
    learned = world.dynamics
    if not isinstance(learned, NeRDDynamics):
        return {BROKEN: 0.0, OFF: 0.0}  # MuJoCo has none
    model = learned.model
    was = model.dtype
    model.network.double()  # finite differences of float32 are noise
    try:
        dynamics = NeRDDynamics(model, differentiable=True)
        return _figures(dynamics, _begin(world.scene, generator), generator)
    finally:
        model.network.to(was)


def _begin(scene: Scene, generator: Generator) -> TensorDict:
    """On the ground where a robot can lie there, and moving a little."""
    start = starts(scene, ROWS, generator)
    if not has_floating_base(scene):
        return start
    rest = settled(scene, ROWS).clone()
    rest[QVEL] += SLOW * start[QVEL][: len(rest)]
    return rest


def _figures(
    dynamics: NeRDDynamics, start: TensorDict, generator: Generator
) -> Figures:
    torque = uniform_torque(dynamics.scene, len(start), 100, generator)
    given = start[QVEL], torque[:, 0]
    broken, figures = 0, {}
    for steps in (1, 32, 100):
        slopes = _slopes(dynamics, start, given, torque, steps)
        broken += sum(int((~slope.isfinite()).sum()) for slope in slopes)
        highest = max(float(slope.abs().amax()) for slope in slopes if slope.numel())
        figures[f"largest gradient after {steps} steps"] = highest
    slopes = _slopes(dynamics, start, given, torque, 1)
    ways = [
        1e-6
        * (1.0 + x.abs().amax(0))
        * torch.randn(x.shape, generator=generator, dtype=torch.float64)
        for x in given
    ]
    ahead, behind = (
        _end(dynamics, start, [x + s * w for x, w in zip(given, ways, strict=True)])
        for s in (1.0, -1.0)
    )
    found = 0.5 * (ahead - behind).sum().detach()
    pairs = zip(slopes, ways, strict=True)
    expected = torch.stack([(slope * way).sum() for slope, way in pairs]).sum()
    figures[OFF] = float((found - expected).abs() / (expected.abs() + 1e-15))
    return {BROKEN: float(broken), **figures}


def _slopes(
    dynamics: NeRDDynamics,
    start: TensorDict,
    given: tuple[Tensor, Tensor],
    torque: Tensor,
    steps: int,
) -> tuple[Tensor, ...]:
    """Of the summed velocities at the end, by the first velocities and torques."""
    first = [x.clone().requires_grad_() for x in given]
    end = _end(dynamics, start, first, torque[:, 1:steps]).sum()
    return torch.autograd.grad(end, first, allow_unused=True, materialize_grads=True)


def _end(
    dynamics: NeRDDynamics,
    start: TensorDict,
    first: list[Tensor],
    later: Tensor | None = None,
) -> Tensor:
    """Velocities after a step from given velocities and torques, and some later ones."""
    qvel, push = first
    state = start.select(QPOS).set(QVEL, qvel)
    dynamics.reset(state)
    pushes = [push] if later is None else [push, *later.unbind(1)]
    for now in pushes:
        state = dynamics.step(state, now, start.get(TERRAIN, None))
    return state[QVEL]


CASE = Case(
    "gradients",
    "a differentiable step has the slope that it shows, and a long way stays finite",
    _run,
    lines={BROKEN: 0.0, OFF: 1e-4},
    needs_dynamics=True,
)
