"""Physics with a known outcome: conservation, drops, rest, friction, joint limits."""

from collections.abc import Iterator
from math import inf
from typing import cast

import mujoco
import numpy as np
import torch
from tensordict import TensorDict
from torch import Generator, Tensor

from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.evaluation.position_error import position_errors
from torchrl_nerd.evaluation.rollout_error import rollout
from torchrl_nerd.evaluation.stability.case import (
    Metric,
    Trial,
    can_land,
    hard_case,
    has_floating_base,
    largest,
    norm,
)
from torchrl_nerd.evaluation.stability.states import (
    clear_of_ground,
    mechanics,
    robot_mass,
    sample_states,
)
from torchrl_nerd.geometry.manifold import HINGE, SLIDE
from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.scenes import Scene

STEPS, EVERY, EARLY = 10_000, 50, 1_000
FLIGHT_STEPS = 30
SLOW = 0.3  # of the training speeds: MuJoCo's own steps lose momentum at more
HEIGHTS = (0.1, 0.3, 1.0, 3.0, 10.0)  # m
PERTURBATION, NUM_PERTURBED = 1e-2, 4  # m/s and rad/s: a model's own error of a step


def _is_undamped(scene: Scene) -> bool:
    """Whether a robot with a fixed base loses no energy."""
    model = scene.model
    is_damped = model.dof_damping.any() or model.dof_frictionloss.any()
    has_gravity = model.opt.gravity.any()
    return bool(has_gravity and not (scene.base.is_floating or is_damped))


@hard_case(_is_undamped)
def energy(trial: Trial) -> Iterator[Metric]:
    """Without friction and drive the energy stays, as far as MuJoCo keeps it."""
    scene = trial.scene
    start = trial.in_air(16, speed=0.0)  # or a cart would roll off its rail
    steps = trial.scaled(STEPS, EVERY)
    late = _drift(scene, trial.roll(start, steps, every=EVERY))
    early = late[:, : 1 + EARLY // EVERY]
    # a model is to do what its MuJoCo does, which is judged by the reference solver
    exact = trial.roll_exactly(start, min(steps, EARLY), every=EVERY)
    kept = largest(_drift(scene, exact).mean(0))
    allowed = 0.005 + (kept if kept < inf else 0.0)
    for count, drift, limit in (("1,000", early, allowed), ("10,000", late, inf)):
        name = f"energy drift over {count} steps, relative to the potential well"
        yield Metric(name, largest(drift.mean(0)), limit, mujoco_limit=inf)
    if isinstance(trial.dynamics, MujocoDynamics):
        reference = MujocoDynamics(scene.reference)
        path = rollout(reference, start, min(steps, EARLY), every=EVERY)
        name = "energy drift of the reference solver over 1,000 steps, relative"
        yield Metric(name, largest(_drift(scene, path).mean(0)), 0.005)


def _drift(scene: Scene, path: TensorDict) -> Tensor:
    """Change of energy relative to the depth of the well, ``(n, steps)``."""
    # (n * steps,) -> (n, steps)
    joules = mechanics(scene, path.flatten())["energy"].reshape(path.batch_size)
    # the lowest potential energy, as far as random poses find it
    poses = sample_states(scene, 512, Generator().manual_seed(0))
    poses = clear_of_ground(scene, poses.set(QVEL, 0.0 * poses[QVEL]))
    lowest = mechanics(scene, poses)["energy"].min()
    return (joules - joules[:, :1]).abs() / (joules[:, 0].max() - lowest)


def _slow_flight(trial: Trial) -> tuple[dict[str, Tensor], Tensor, Tensor]:
    """`mechanics` of a slow flight ``(16, steps, 3)``, its times (steps, 1), gravity."""
    path = trial.roll(trial.in_air(16, SLOW), FLIGHT_STEPS)
    found = mechanics(trial.scene, path.flatten())
    times = trial.scene.control_step * torch.arange(FLIGHT_STEPS + 1.0).double()
    gravity = torch.from_numpy(trial.scene.model.opt.gravity.copy())
    keys = ("com", "momentum", "angular_momentum")
    return {k: found[k].unflatten(0, (16, -1)) for k in keys}, times[:, None], gravity


@hard_case(has_floating_base)
def free_fall(trial: Trial) -> Iterator[Metric]:
    """The centre of mass of a robot in the air follows a parabola."""
    found, time, gravity = _slow_flight(trial)
    option = trial.scene.model.opt
    velocity = found["momentum"][:, :1] / robot_mass(trial.scene)
    # semi-implicit Euler falls as if half a substep had passed more
    is_exact = option.integrator == mujoco.mjtIntegrator.mjINT_RK4
    fall = 0.5 * gravity * time * (time + (0.0 if is_exact else option.timestep))
    miss = norm(found["com"] - found["com"][:, :1] - velocity * time - fall)
    name = "position error of the centre of mass after 30 steps, m"
    yield Metric(name, largest(miss.mean(0)), 0.02, 1e-3)
    yield Metric("largest position error of any trajectory, m", largest(miss))


@hard_case(has_floating_base)
def momentum(trial: Trial) -> Iterator[Metric]:
    """In the air momentum changes by gravity alone, however the joints move."""
    found, time, gravity = _slow_flight(trial)
    mass = robot_mass(trial.scene)
    linear = found["momentum"] / mass - time * gravity
    angular = found["angular_momentum"] / (mass * trial.scene.model.stat.extent)
    for name, value in {
        "change of linear momentum without gravity, relative": linear,
        "change of angular momentum, relative": angular,
    }.items():
        yield Metric(name, largest(norm(value - value[:, :1]).mean(0)), 0.02, 5e-4)


@hard_case(can_land)
def drop(trial: Trial) -> Iterator[Metric]:
    """Dropped from up to 10 m it lands, does not penetrate and never rises higher."""
    z = trial.scene.base.qpos_address + 2
    lying = trial.settled(16)
    # the first pose at rest, once for every height
    start = cast(TensorDict, lying[torch.zeros(len(HEIGHTS), dtype=torch.long)])
    start[QPOS][:, z] += torch.tensor(HEIGHTS, dtype=torch.float64)
    height = trial.roll(start, 300)[QPOS][..., z]  # (heights, 301)
    exact = trial.roll_exactly(start, 300)[QPOS][..., z]
    below = largest(exact.amin(1) - height.amin(1))
    yield Metric("lowest height below MuJoCo's, m", below, 0.05, 1e-9)
    rise = largest((height[:, 1:] - height[:, :1]).amax(1))
    yield Metric("rise above the start, m", rise, 0.02, 1e-3)
    end = largest((height[:, -1] - exact[:, -1]).abs())
    yield Metric("final height error, m", end)


@hard_case(can_land)
def resting(trial: Trial) -> Iterator[Metric]:
    """Started where MuJoCo came to rest it stays there, on the ground and not in it."""
    scene, start, kept = trial.scene, trial.settled(16), 100
    steps = trial.scaled(10_000, kept)
    path = trial.roll(start, steps, every=steps // kept)
    here = path[QPOS]  # (n, 1 + kept, nq)
    errors = position_errors(scene, here[:, :1].expand_as(here), here)
    per_second = 1e3 / (scene.control_step * steps)
    drift, turn = (errors[k][:, -1] for k in ("base_position", "base_orientation"))
    yield Metric("drift, mm/s", per_second * largest(drift), 1.0)
    yield Metric("rotation, mrad/s", per_second * largest(turn), 1.0)
    depth = mechanics(scene, path.flatten())["penetration"]
    yield Metric("penetration, m", largest(depth), 0.02)


@hard_case(can_land)
def sliding(trial: Trial) -> Iterator[Metric]:
    """Pushed along the ground at 1 m/s it stops."""
    start = trial.settled(16)
    v, q = trial.scene.base.dof_address, trial.scene.base.qpos_address
    direction = trial.normal(len(start), 2)
    start[QVEL][:, v : v + 2] = direction / norm(direction)[:, None]  # 1 m/s
    end = cast(TensorDict, trial.roll(start, 300)[:, -1])
    exact = cast(TensorDict, trial.roll_exactly(start, 300)[:, -1])
    left = largest(norm(end[QVEL][:, v : v + 3]))
    yield Metric("speed after 300 steps, m/s", left, 0.1, 0.02)
    gap = norm((end[QPOS] - exact[QPOS])[:, q : q + 2])
    yield Metric("mean error of the stopping point, m", float(gap.mean()))


def _limited(scene: Scene) -> tuple[list[int], Tensor]:
    """Addresses ``(J)`` in ``qpos`` and ranges ``(J, 2)`` of limited hinges and slides."""
    model = scene.model
    found = np.isin(model.jnt_type, (SLIDE, HINGE)) & (model.jnt_limited == 1)
    return model.jnt_qposadr[found].tolist(), torch.from_numpy(model.jnt_range[found])


@hard_case(lambda scene: bool(scene.controller.num_actions and _limited(scene)[0]))
def joint_limits(trial: Trial) -> Iterator[Metric]:
    """Full torque or control presses no joint farther beyond its limit than in MuJoCo."""
    scene, start = trial.scene, trial.starts(16)
    addresses, ranges = _limited(scene)
    middle, half = scene.sampling.commands
    command = middle + trial.normal(16, 1, len(half)).sign() * half

    def exceeded(path: TensorDict) -> Tensor:
        """How far beyond its limit each joint went, ``(n, joints)``."""
        position = cast(Tensor, path[QPOS])[..., addresses]
        low, high = ranges.unbind(-1)
        beyond = torch.maximum(low - position, position - high)
        return beyond.amax(1).clamp(min=0.0)

    own, exact = exceeded(trial.roll(start, 200, command)), []
    # a trajectory near a limit may miss it: MuJoCo's nearby ones count too
    for size in (0.0, *[PERTURBATION] * NUM_PERTURBED):
        nearby = start.clone()
        nearby[QVEL] += size * trial.normal(*nearby[QVEL].shape)
        exact.append(exceeded(trial.roll_exactly(nearby, 200, command)))
    more = largest(own - torch.stack(exact).amax(0))
    yield Metric("limit exceeded by more than in MuJoCo, rad or m", more, 0.2, 1e-9)
    yield Metric("limit exceeded in MuJoCo, rad or m", largest(exact[0]))
