"""Conservation: energy, momentum, and the parabola of free fall."""

import torch
from tensordict import TensorDict
from torch import Generator, Tensor

from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.evaluation.rollout_error import rollout
from torchrl_nerd.evaluation.stability.case import (
    Metrics,
    Trial,
    hard_case,
    has_floating_base,
    largest,
    norm,
)
from torchrl_nerd.evaluation.stability.states import (
    clear_of_ground,
    mechanics,
    sample_states,
)
from torchrl_nerd.keys import QVEL
from torchrl_nerd.scenes import Scene

STEPS, EVERY, EARLY = 10_000, 50, 1_000
DRIFT = "energy drift over 1,000 steps, relative to the potential well"
LATE = "energy drift over 10,000 steps, relative to the potential well"
REFERENCE = "energy drift of the reference solver over 1,000 steps, relative"
MISS = "position error of the centre of mass after 30 steps, m"
LINEAR = "change of linear momentum without gravity, relative"
ANGULAR = "change of angular momentum, relative"
FLIGHT_STEPS = 30
SLOW = 0.3  # of the training speeds: MuJoCo's own steps lose momentum at more


def _is_undamped(scene: Scene) -> bool:
    """Whether a robot with a fixed base loses no energy."""
    model = scene.model
    is_damped = model.dof_damping.any() or model.dof_frictionloss.any()
    has_gravity = model.opt.gravity.any()
    return bool(has_gravity and not (scene.base.is_floating or is_damped))


# the scene's own integrator may not keep the energy, so MuJoCo is judged by the reference
@hard_case({DRIFT: 0.005}, {REFERENCE: 0.005}, _is_undamped)
def energy(trial: Trial) -> Metrics:
    """Without friction and drive the energy stays, as far as the solver keeps it."""
    scene = trial.scene
    start = trial.in_air(16, speed=0.0)  # or a cart would roll off its rail
    steps = trial.scaled(STEPS, EVERY)
    drift = _drift(scene, trial.roll(start, steps, every=EVERY))
    early = drift[:, : 1 + EARLY // EVERY]
    metrics = {DRIFT: largest(early.mean(0)), LATE: largest(drift.mean(0))}
    if isinstance(trial.dynamics, MujocoDynamics):
        reference = MujocoDynamics(scene.reference)
        path = rollout(reference, start, min(steps, EARLY), every=EVERY)
        metrics[REFERENCE] = largest(_drift(scene, path).mean(0))
    return metrics


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


@hard_case({MISS: 0.02}, {MISS: 1e-3}, has_floating_base)
def free_fall(trial: Trial) -> Metrics:
    """The centre of mass of a robot in the air follows a parabola."""
    found, time, gravity = _slow_flight(trial)
    model = trial.scene.model
    velocity = found["momentum"][:, :1] / float(model.body_mass.sum())
    # semi-implicit Euler falls as if half a substep had passed more
    fall = 0.5 * gravity * time * (time + model.opt.timestep)
    miss = norm(found["com"] - found["com"][:, :1] - velocity * time - fall)
    name = "largest position error of any trajectory, m"
    return {MISS: largest(miss.mean(0)), name: largest(miss)}


LIMITS = {LINEAR: 0.02, ANGULAR: 0.02}


@hard_case(LIMITS, dict.fromkeys(LIMITS, 5e-4), has_floating_base)
def momentum(trial: Trial) -> Metrics:
    """In the air momentum changes by gravity alone, however the joints move."""
    found, time, gravity = _slow_flight(trial)
    mass = float(trial.scene.model.body_mass.sum())
    linear = found["momentum"] / mass - time * gravity
    angular = found["angular_momentum"] / (mass * trial.scene.model.stat.extent)
    both = {LINEAR: linear, ANGULAR: angular}
    return {name: largest(norm(p - p[:, :1]).mean(0)) for name, p in both.items()}
