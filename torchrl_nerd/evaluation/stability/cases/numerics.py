"""Invariance, and numbers: long runs, extreme torques, bad input, batches, gradients."""

from collections.abc import Iterator
from math import inf
from typing import cast

import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_nerd.dynamics import NeRDDynamics
from torchrl_nerd.evaluation.stability.case import (
    Metric,
    Trial,
    can_land,
    hard_case,
    has_floating_base,
    largest,
    norm,
)
from torchrl_nerd.evaluation.stability.states import rotated
from torchrl_nerd.keys import QPOS, QVEL, TERRAIN
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.commands import drive
from torchrl_nerd.scenes.symmetries import periodic_hinges

KEPT = 1000  # states of a long rollout
ROUNDING = 1e-6
BATCH, NUM_SINGLE = 4096, 8
INVALID = (float("nan"), inf, -inf, 1e200, 5e-324)
SLOW = 0.1  # of the training speeds


def _has_level_ground(scene: Scene) -> bool:
    """Whether a floating base moves over one fixed plane."""
    plane = scene.terrain is not None and scene.terrain.fixed_plane is not None
    return scene.base.is_floating and plane


def _shifted(
    trial: Trial,
    start: TensorDict,
    address: int | list[int],
    by: float,
    torque: Tensor | None = None,
    steps: int = 10,
) -> float:
    """Difference after some steps if entries of ``qpos`` start ``by`` farther."""
    other = start.clone()
    other[QPOS][:, address] += by
    here, there = (trial.roll(s, steps, torque) for s in (start, other))
    there[QPOS][..., address] -= by
    return largest(trial.difference(here, there))


@hard_case(has_floating_base)
def altitude(trial: Trial) -> Iterator[Metric]:
    """How far contact points are beyond their margin does not change the motion."""
    start, torque = trial.in_air(8, speed=1.0), trial.commands(8, 10)
    z = trial.scene.base.qpos_address + 2
    shifts = [_shifted(trial, start, z, by, torque) for by in (1.0, 1e3, 1e6)]
    name = "difference after 10 steps, 1 m to 1,000 km higher, m"
    yield Metric(name, max(shifts), 1e-6)


@hard_case(_has_level_ground)
def translation(trial: Trial) -> Iterator[Metric]:
    """Level ground is the same everywhere; a float64 holds 1e-10 m at 1,000 km."""
    start, x = trial.starts(8), trial.scene.base.qpos_address
    *near, far = (_shifted(trial, start, x, by) for by in (1.0, 1e2, 1e4, 1e6))
    name = "difference after 10 steps, 1 m to 10 km away, m or rad"
    yield Metric(name, max(near), 1e-4)
    name = "difference after 10 steps, 1,000 km away, m or rad"
    yield Metric(name, far, 1e-2, mujoco_limit=inf)


@hard_case(_has_level_ground)
def yaw(trial: Trial) -> Iterator[Metric]:
    """Level ground is the same in every direction, as is MuJoCo's elliptic cone."""
    start = trial.starts(16)
    w, z = torch.nn.functional.normalize(trial.normal(16, 2)).unbind(-1)
    zero = torch.zeros_like(w)
    quat = torch.stack((w, zero, zero, z), -1)  # (16, 4)
    here = rotated(trial.scene, trial.roll(start, 10), quat[:, None])
    there = trial.roll(rotated(trial.scene, start, quat), 10)
    worst = trial.difference(here, there).amax(1)
    name = "median difference after 10 steps, m or rad"
    yield Metric(name, float(worst.median()), 1e-4)
    yield Metric("largest difference after 10 steps, m or rad", largest(worst))


@hard_case(has_floating_base)
def quaternion_sign(trial: Trial) -> Iterator[Metric]:
    """A quaternion q and its negative -q are one orientation."""
    q = trial.scene.base.qpos_address + 3
    start, torque = trial.starts(16), trial.commands(16, 10)
    other = start.clone()
    other[QPOS][:, q : q + 4] *= -1.0
    paths = [trial.roll(s, 10, torque) for s in (start, other)]
    worst = largest(trial.difference(*paths))
    yield Metric("largest difference after 10 steps, m or rad", worst, 1e-6)


def _periodic(scene: Scene) -> list[int]:
    return periodic_hinges(scene.model, scene.servos is not None)


@hard_case(lambda scene: bool(_periodic(scene)))
def hinge_turns(trial: Trial) -> Iterator[Metric]:
    """A hundred turns of a hinge without limits and springs change nothing."""
    start, torque = trial.starts(16), trial.commands(16, 20)
    turns, hinges = 200.0 * torch.pi, _periodic(trial.scene)
    shift = _shifted(trial, start, hinges, turns, torque, steps=20)
    yield Metric("difference after 100 turns and 20 steps, rad", shift, 1e-6)


@hard_case(lambda scene: scene.controller.num_actions > 0)
def torques(trial: Trial) -> Iterator[Metric]:
    """Zero, largest, 1000-fold and alternating torques leave every state finite."""
    middle, high = trial.scene.sampling.commands
    sign = torch.tensor([1.0, -1.0], dtype=torch.float64)[:, None]
    zero, full = torch.zeros(2, len(high)).double(), high.expand(2, -1)
    # (4, 2, m)
    kinds = middle + torch.stack((zero, full, 1000.0 * full, sign * full))
    start = trial.starts(16)
    steps = trial.scaled(1000, 20)
    path = trial.roll(start, steps, kinds.repeat(4, 1, 1), steps // 20)
    yield from _finiteness(path, fastest=1e3)


@hard_case()
def horizon(trial: Trial) -> Iterator[Metric]:
    """Over 100,000 steps states stay finite and move no farther than their speed allows."""
    scene, steps = trial.scene, trial.scaled(100_000, KEPT) // KEPT * KEPT
    path = trial.roll(trial.starts(8), steps, trial.commands(8, 512), steps // KEPT)
    yield from _finiteness(path, fastest=inf)
    leap = 0.0
    if scene.base.is_floating and isinstance(trial.dynamics, NeRDDynamics):
        q, v = scene.base.qpos_address, scene.base.dof_address
        moved = path[QPOS][..., q : q + 3].diff(dim=1)  # (n, KEPT, 3)
        bound = float(trial.model.training_range.speed[v])
        seconds = scene.control_step * (steps // KEPT)
        beyond = norm(moved) - (1.0 + ROUNDING) * bound * seconds
        leap = float(beyond.clamp(min=0.0).amax())
    yield Metric("distance beyond the speed bound times time, m", leap, 0.0, inf)


def _finiteness(path: TensorDict, fastest: float) -> Iterator[Metric]:
    """How many trajectories are not finite, and the largest speed of the others."""
    state = torch.cat((path[QPOS], path[QVEL]), -1)  # (n, steps, nq + nv)
    is_finite = state.isfinite().flatten(1).all(1)
    speed = path[QVEL].abs().nan_to_num(0.0, 0.0, 0.0).amax()
    yield Metric("non-finite trajectories", float((~is_finite).sum()), 0.0, inf)
    yield Metric("largest speed, m/s or rad/s", float(speed), fastest, inf)


@hard_case()
def invalid_inputs(trial: Trial) -> Iterator[Metric]:
    """An invalid value in one of 4,096 trajectories changes no bit of another."""
    count = trial.scaled(BATCH, NUM_SINGLE)
    start, torque = trial.starts(count), trial.commands(count, 3)
    expected = trial.roll(start, 3, torque)
    changed = 0
    for value in INVALID:
        index = int(torch.randint(count, (), generator=trial.generator))
        others = torch.arange(count) != index
        for key in (QPOS, QVEL, "torque"):
            bad, told = start.clone(), torque.clone()
            (told if key == "torque" else bad[key])[index] = value
            got = trial.roll(bad, 3, told)
            for name in (QPOS, QVEL):
                changed += int((got[name][others] != expected[name][others]).sum())
    yield Metric("changed values in other trajectories", float(changed), 0.0)


@hard_case()
def batching(trial: Trial) -> Iterator[Metric]:
    """A trajectory does not depend on its batch but for the order of float32 sums."""
    count = trial.scaled(BATCH, NUM_SINGLE)
    start, torque = trial.starts(count), trial.commands(count, 3)

    def velocities(index: Tensor) -> Tensor:
        return trial.roll(cast(TensorDict, start[index]), 3, torque[index])[QVEL]

    together = velocities(torch.arange(count))  # (count, 4, nv)
    order = torch.randperm(count, generator=trial.generator)
    single = torch.cat([velocities(i) for i in torch.arange(NUM_SINGLE).split(1)])
    for name, x, other in (
        ("single against batched, relative", together[:NUM_SINGLE], single),
        ("permuted batch, relative", together[order], velocities(order)),
    ):
        size = 1.0 + x.abs().amax((1, 2), keepdim=True)  # (n, 1, 1)
        yield Metric(name, largest(((other - x) / size).abs()), 1e-4, 0.0)


@hard_case(needs_model=True)
def gradients(trial: Trial) -> Iterator[Metric]:
    """Gradients equal finite differences and stay finite over 100 steps."""
    start = trial.starts(8)
    if can_land(trial.scene):  # on the ground, moving slowly
        lying = trial.settled(8)
        lying[QVEL] += SLOW * start[QVEL][: len(lying)]
        start = lying
    commands = trial.commands(len(start), 100)
    model, dtype = trial.model, trial.model.dtype
    model.network.double()  # finite differences of float32 are noise
    dynamics = NeRDDynamics(model, differentiable=True)

    def end(first: list[Tensor], steps: int) -> Tensor:
        """Sum of the final velocities, from first velocities and commands."""
        state = start.select(QPOS).set(QVEL, first[0])
        dynamics.reset(state)
        for now in (first[1], *commands[:, 1:steps].unbind(1)):
            torque, ctrl = drive(trial.scene, now, state[QPOS], state[QVEL])
            state = dynamics.step(state, torque, start.get(TERRAIN, None), ctrl)
        return state[QVEL].sum()

    def gradient(steps: int) -> tuple[Tensor, ...]:
        leaves = [x.clone().requires_grad_() for x in first]
        return torch.autograd.grad(
            end(leaves, steps), leaves, allow_unused=True, materialize_grads=True
        )

    first, non_finite = [start[QVEL], commands[:, 0]], 0.0
    try:
        for steps in (1, 32, 100):
            found = gradient(steps)
            non_finite += sum(float((~g.isfinite()).sum()) for g in found)
            size = max(float(g.abs().amax()) for g in found if g.numel())
            yield Metric(f"largest gradient after {steps} steps", size)
        shift = [1e-6 * (1.0 + x.abs().amax(0)) * trial.normal(*x.shape) for x in first]
        pairs = list(zip(first, shift, strict=True))
        # central difference along one random direction
        ahead, behind = (end([x + s * d for x, d in pairs], 1) for s in (1.0, -1.0))
        central = 0.5 * (ahead - behind).detach()
        along = [(g * d).sum() for g, d in zip(gradient(1), shift, strict=True)]
        expected = torch.stack(along).sum()
        error = float((central - expected).abs() / (expected.abs() + 1e-15))
    finally:
        model.network.to(dtype)
    yield Metric("non-finite gradients", non_finite, 0.0)
    yield Metric("one step against finite differences, relative", error, 1e-4)
