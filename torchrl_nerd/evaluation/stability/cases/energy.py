"""Conservation: energy, momentum, and closed forms of unconstrained motion."""

import mujoco
import numpy as np
import torch
from scipy.integrate import solve_ivp
from tensordict import TensorDict
from torch import Generator, Tensor

from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.evaluation.stability.case import (
    Metrics,
    Trial,
    hard_case,
    has_floating_base,
)
from torchrl_nerd.evaluation.stability.measures import largest, mechanics
from torchrl_nerd.evaluation.stability.states import clear_of_ground, sample_states
from torchrl_nerd.evaluation.stability.stepper import DynamicsStepper
from torchrl_nerd.evaluation.traces import energy as total_energy
from torchrl_nerd.geometry.rotations import quat_matrix
from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.scenes import Scene

STEPS, EVERY, EARLY = 10_000, 50, 1_000
DRIFT = "energy drift over 1,000 steps, relative to the potential well"
LATE = "energy drift over 10,000 steps, relative to the potential well"
REFERENCE = "energy drift of the reference solver over 1,000 steps, relative"
MISS = "position error of the centre of mass after 30 steps, m"
LINEAR = "change of linear momentum without gravity, relative"
ANGULAR = "change of angular momentum, relative"
EULER = "deviation from Euler's equations after 30 steps, relative"
FLIGHT_STEPS = 30
SLOW = 0.3  # of the training speeds: MuJoCo's own steps lose momentum at more
SPIN, WOBBLE = 3.0, 0.01  # rad/s about the middle axis; relative about the others


def _is_undamped(scene: Scene) -> bool:
    """Whether a robot with a fixed base loses no energy."""
    model = scene.model
    is_damped = model.dof_damping.any() or model.dof_frictionloss.any()
    has_gravity = model.opt.gravity.any()
    return bool(has_gravity and not (scene.base.is_floating or is_damped))


@hard_case(
    _is_undamped,
    {DRIFT: 0.005},
    {REFERENCE: 0.005},  # the scene's own integrator may not keep it
)
def energy(trial: Trial) -> Metrics:
    """Without friction and drive the energy stays, as far as the solver keeps it."""
    scene, start = trial.scene, trial.in_air(16)
    start[QVEL] = 0.0 * start[QVEL]  # or a cart would roll off to the end of its rail
    steps = trial.scaled(STEPS, EVERY)
    drift = _drift(scene, trial.roll(start, steps, every=EVERY))
    early = drift[:, : 1 + EARLY // EVERY]
    metrics = {
        DRIFT: largest(early.mean(0)),
        "largest energy drift of any trajectory over 1,000 steps": largest(early),
        LATE: largest(drift.mean(0)),
    }
    if trial.stepper.is_ground_truth:
        reference = DynamicsStepper(MujocoDynamics(scene.reference))
        path = reference.roll(start, min(steps, EARLY), every=EVERY)
        metrics[REFERENCE] = largest(_drift(scene, path).mean(0))
    return metrics


def _drift(scene: Scene, path: TensorDict) -> Tensor:
    """Change of energy relative to the depth of the well, ``(n, steps)``."""
    qpos, qvel = (path[key].flatten(0, 1) for key in (QPOS, QVEL))
    joules = total_energy(scene, qpos, qvel).reshape(path.batch_size)
    # the lowest potential energy, as far as random poses find it
    poses = sample_states(scene, 512, Generator().manual_seed(0))
    poses = clear_of_ground(scene, poses)
    lowest = total_energy(scene, poses[QPOS], torch.zeros_like(poses[QVEL])).min()
    return (joules - joules[:, :1]).abs() / (joules[:, 0].max() - lowest)


def _slow_flight(trial: Trial) -> dict[str, np.ndarray]:
    """`mechanics` of a slow flight, ``(16, FLIGHT_STEPS + 1, 3)``."""
    start = trial.in_air(16)
    start[QVEL] = SLOW * start[QVEL]
    found = mechanics(trial.scene, trial.roll(start, FLIGHT_STEPS).flatten())
    keys = ("com", "momentum", "angular_momentum")
    return {key: found[key].reshape(16, -1, 3) for key in keys}


def _flight_times(scene: Scene) -> np.ndarray:
    """s, ``(FLIGHT_STEPS + 1, 1)``."""
    return scene.control_step * np.arange(FLIGHT_STEPS + 1)[:, None]


@hard_case(
    has_floating_base,
    {MISS: 0.02},
    {MISS: 1e-3},
)
def free_fall(trial: Trial) -> Metrics:
    """The centre of mass of a robot in the air follows a parabola."""
    found, model = _slow_flight(trial), trial.scene.model
    time = _flight_times(trial.scene)
    velocity = found["momentum"][:, :1] / model.body_mass.sum()
    # semi-implicit Euler falls as if half a substep had passed more
    fall = 0.5 * model.opt.gravity * time * (time + model.opt.timestep)
    parabola = found["com"][:, :1] + velocity * time + fall
    miss = np.linalg.norm(found["com"] - parabola, axis=-1)
    name = "largest position error of any trajectory, m"
    return {MISS: largest(miss.mean(0)), name: largest(miss)}


@hard_case(
    has_floating_base,
    {LINEAR: 0.02, ANGULAR: 0.02},
    {LINEAR: 5e-4, ANGULAR: 5e-4},
)
def momentum(trial: Trial) -> Metrics:
    """In the air momentum changes by gravity alone, however the joints move."""
    found, model = _slow_flight(trial), trial.scene.model
    mass = model.body_mass.sum()
    linear = found["momentum"] - _flight_times(trial.scene) * mass * model.opt.gravity
    changes = [
        np.linalg.norm(p - p[:, :1], axis=-1).mean(0)
        for p in (linear, found["angular_momentum"])
    ]
    return {
        LINEAR: largest(changes[0] / mass),
        ANGULAR: largest(changes[1] / (mass * model.stat.extent)),
    }


def _is_one_body(scene: Scene) -> bool:
    kinds = scene.model.jnt_type
    return len(kinds) == 1 and kinds[0] == mujoco.mjtJoint.mjJNT_FREE


@hard_case(
    _is_one_body,
    {EULER: 0.02},
    {EULER: 5e-3},
)
def tumbling(trial: Trial) -> Metrics:
    """A body that rotates about its middle axis follows Euler's equations."""
    scene, v = trial.scene, trial.scene.base.dof_address + 3
    body = int(scene.model.jnt_bodyid[0])
    inertia = scene.model.body_inertia[body]
    axes = quat_matrix(scene.model.body_iquat[body])
    middle = np.eye(3)[np.argsort(inertia)[1]]
    first = SPIN * (middle + WOBBLE * trial.normal(16, 3).numpy())
    start = trial.in_air(16)
    start[QVEL] = 0.0 * start[QVEL]
    start[QVEL][:, v:] = torch.from_numpy(first @ axes.T)
    path = trial.roll(start, FLIGHT_STEPS)[QVEL][..., v:].numpy() @ axes
    times = _flight_times(scene)[:, 0]
    exact = np.stack([_euler(inertia, omega, times) for omega in first])
    return {EULER: largest(np.linalg.norm(path - exact, axis=-1).mean(0)) / SPIN}


def _euler(inertia: np.ndarray, first: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Angular velocity about principal axes ``(steps, 3)`` without torque."""

    def rate(_: float, omega: np.ndarray) -> np.ndarray:
        return np.cross(inertia * omega, omega) / inertia

    span = times[0], times[-1]
    return solve_ivp(rate, span, first, t_eval=times, rtol=1e-10, atol=1e-12).y.T
