"""Ranges of training states and torques that follow from a compiled model.

Positions fill the joint limits (half a turn or a metre to both sides where there is none).
Torques are the largest the actuators can give. Where one of them, held over a control
step, changes a joint's speed by more than four times its range, none changes it by more
than a sixteenth, and all speeds are halved. A hinge's speed is what gravity and its own
torque together reach over half its range, against its inertia and armature, less where its
damper allows less. A slide's is that of a fall over twice its reach, or what its own force
reaches. None crosses its range in less than `CROSSING`. All are halved until MuJoCo does
not give up on them, see `_stable`. A floating base starts at its place in the file,
anywhere above the ground there up to twice the robot's reach, turned any way; a prop starts
near its place in the file.
"""

import copy
from dataclasses import fields, replace
from math import cos, pi, sin, sqrt
from typing import Any

import mujoco
import numpy as np
import torch

from torchrl_nerd.geometry.base import Base, ancestors
from torchrl_nerd.geometry.manifold import BALL, FREE, HINGE, SLIDE
from torchrl_nerd.scenes.contact_points import contact_points, terrain_geoms
from torchrl_nerd.scenes.controllers import ActuatorController
from torchrl_nerd.scenes.sampling import BaseSampling, Sampling, uniform
from torchrl_nerd.scenes.support import silence_mujoco

FREE_SLIDE = 1.0  # m
CROSSING = 0.1  # s
MAX_GAIN = 4.0  # changes of speed in a control step over a joint's speed range
PROP_ROOM = 0.1  # m: how far from its place a prop starts at least
LEAST_REACH = 0.01  # m
HIGHEST = 1e3  # m: ground above a robot is looked for from here
START_PENETRATION = 1e-3  # m: about what a resting robot's soft contacts give
LEAST_SPEED = 1.0  # m/s or rad/s: where nothing falls and nothing pushes
MAX_HALVINGS, TRIALS, TRIAL_STEPS, MAX_LOST = 8, 64, 50, 0.02
DRAWS = 4096  # of actions and states, to find the largest torques


def default_sampling(
    model: mujoco.MjModel,
    controller: ActuatorController,
    control_step: float,
    **ranges: Any,
) -> Sampling:
    """Sampling ranges from limits and strengths of a compiled model.

    ``control_step``: s, over which a torque is held.
    ``ranges``: fields of `Sampling` to use in place of the default ones; ValueError where
    one is none, or of torques where servos take controls.
    """
    known = [field.name for field in fields(Sampling)]
    if unknown := [name for name in ranges if name not in known]:
        raise ValueError(
            f"expected ranges among {', '.join(known)}, got '{unknown[0]}'"
        )
    other = "ctrl" if controller.is_motor else "torque"
    if other in ranges:
        wanted = "torque of motors" if controller.is_motor else "ctrl of servos"
        raise ValueError(f"expected the {wanted}, got a range of '{other}'")
    base = Base.from_model(model)
    # a floating base has ranges of its own where it is the first joint
    is_first = base.is_floating and base.dof_address == 0
    skipped_q, skipped_v = (7, 6) if is_first else (0, 0)
    low, high = (tuple(x.tolist()) for x in position_ranges(model))
    torque = _largest_torques(model, controller, low, high)
    speed = _speeds(model, controller, torque).tolist()
    dofs = list(controller.dof_addresses)
    inertia, damping = model.dof_M0[dofs], model.dof_damping[dofs]
    gentle = np.array(speed)[dofs] * (inertia / control_step + damping)
    if np.any(np.array(torque) > MAX_GAIN * gentle):  # no damper, and far too strong
        torque = np.minimum(torque, gentle / MAX_GAIN**2).tolist()
        speed = [0.5 * v for v in speed]
    controls = controller.ctrl_low, controller.ctrl_high
    sampling = Sampling(
        qpos_low=low[skipped_q:],
        qpos_high=high[skipped_q:],
        qvel_low=tuple(-v for v in speed[skipped_v:]),
        qvel_high=tuple(speed[skipped_v:]),
        torque=tuple(torque),
        base=_base_sampling(model, speed) if is_first else None,
        ctrl=None if controller.is_motor else controls,
        clearance=0.0 if len(contact_points(model, base)) else None,
        penetration=START_PENETRATION,
    )
    return replace(sampling, **ranges)


def position_ranges(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest ``qpos``; quaternions are yet to be normalised."""
    low, high, reaches = model.qpos0.copy(), model.qpos0.copy(), _reaches(model)
    for joint in range(model.njnt):
        q, kind = int(model.jnt_qposadr[joint]), int(model.jnt_type[joint])
        limits, is_limited = model.jnt_range[joint], bool(model.jnt_limited[joint])
        if kind == BALL:  # (c, s u) with u in the unit cube turns by its limit at most
            half = min(limits[1], pi) / 2.0 if is_limited else pi / 2.0
            side = sin(half) / sqrt(3.0)
            low[q : q + 4] = (cos(half), -side, -side, -side)
            high[q : q + 4] = (cos(half), side, side, side)
        elif kind == FREE:
            room = max(reaches[joint], PROP_ROOM)
            low[q : q + 3] -= (room, room, 0.0)
            high[q : q + 3] += room
            low[q + 3 : q + 7], high[q + 3 : q + 7] = -1.0, 1.0  # normalised later
        else:
            free = pi if kind == HINGE else FREE_SLIDE
            low[q] = limits[0] if is_limited else low[q] - free
            high[q] = limits[1] if is_limited else high[q] + free
    return low, high


def _largest_torques(
    model: mujoco.MjModel, controller: ActuatorController, low: tuple, high: tuple
) -> list[float]:
    """Largest torque of each driven dof, at rest and at full action to either side."""
    generator = torch.Generator().manual_seed(0)
    qpos = uniform(low, high, DRAWS, generator)
    sides = uniform((-1.0,) * model.nu, (1.0,) * model.nu, DRAWS, generator).sign()
    torque = controller(sides, qpos, qpos.new_zeros(DRAWS, model.nv))
    return torque.abs().amax(0).tolist()


def _speeds(
    model: mujoco.MjModel, controller: ActuatorController, torque: list[float]
) -> np.ndarray:
    """Largest speed of every dof, m/s or rad/s, to three digits."""
    joint, damping = model.dof_jntid, model.dof_damping
    kind, reach = model.jnt_type[joint], _reaches(model)[joint]
    fall = 2.0 * np.sqrt(
        np.linalg.norm(model.opt.gravity) * reach
    )  # over twice the reach
    width = np.where(kind == SLIDE, 2.0 * FREE_SLIDE, 2.0 * pi)
    is_limited = (model.jnt_limited[joint] > 0) & (kind != BALL)
    width = np.where(is_limited, np.ptp(model.jnt_range[joint], 1), width)
    effort = _gravity_moments(model)[joint] * (kind != SLIDE)
    effort[list(controller.dof_addresses)] += torque
    speed = np.sqrt(effort * width / model.dof_M0)
    at_most = np.full(model.nv, np.inf)
    speed = np.minimum(speed, np.divide(effort, damping, at_most, where=damping > 0.0))
    speed = np.where(kind == SLIDE, np.maximum(speed, fall), speed)
    speed = np.minimum(speed, width / CROSSING)
    is_linear = np.arange(model.nv) < model.jnt_dofadr[joint] + 3
    free = np.where(is_linear, fall, fall / np.maximum(reach, LEAST_REACH))
    speeds = np.maximum(np.where(kind == FREE, free, speed), LEAST_SPEED)
    slower = _stable(model, controller, speeds)
    return np.array([float(f"{speed:.3g}") for speed in slower])


def _stable(
    model: mujoco.MjModel, controller: ActuatorController, speeds: np.ndarray
) -> np.ndarray:
    """Speeds halved, all alike, until MuJoCo steps random states without giving up.

    Its timestep may be too long for the drag of a fluid. Contact is off: starts are clear.
    Speeds that halving does not help stay as they are.
    """
    free, rng = copy.copy(model), np.random.default_rng(0)
    free.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    (low, high), data = position_ranges(model), mujoco.MjData(free)
    controls = np.array((controller.ctrl_low, controller.ctrl_high)).reshape(2, -1)
    for halvings in range(MAX_HALVINGS):
        slower, num_lost = speeds / 2.0**halvings, 0
        for _ in range(TRIALS):
            mujoco.mj_resetData(free, data)
            data.qpos[:] = rng.uniform(low, high)
            mujoco.mj_normalizeQuat(free, data.qpos)
            data.qvel[:] = rng.uniform(-slower, slower)
            data.ctrl[:] = rng.uniform(*controls)
            with silence_mujoco():
                mujoco.mj_step(free, data, TRIAL_STEPS)
            num_lost += bool(data.warning.number.any())
        if num_lost <= TRIALS * MAX_LOST:
            return slower
    return speeds


def _gravity_moments(model: mujoco.MjModel) -> np.ndarray:
    """Largest moment of gravity about each joint's anchor, N m, ``(njnt,)``."""
    data, size = mujoco.MjData(model), np.linalg.norm(model.opt.gravity)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    bodies = model.jnt_bodyid
    arms = np.linalg.norm(data.subtree_com[bodies] - data.xanchor, axis=1)
    return size * model.body_subtreemass[bodies] * arms


def _reaches(model: mujoco.MjModel) -> np.ndarray:
    """Distance from each joint to the far end of all that hangs on it, m, ``(njnt,)``."""
    data, reaches = mujoco.MjData(model), np.zeros(model.njnt)
    mujoco.mj_forward(model, data)
    hangs = ancestors(model)[np.ix_(model.geom_bodyid, model.jnt_bodyid)]
    for geom, joint in np.argwhere(hangs):
        offset = data.geom_xpos[geom] - data.xanchor[joint]
        reach = np.linalg.norm(offset) + model.geom_rbound[geom]
        reaches[joint] = max(reaches[joint], reach)
    return reaches


def _ground_below(model: mujoco.MjModel, place: tuple[float, float, float]) -> float:
    """Height of the ground under a place, m; else of what is over it; else 0."""
    data, down = mujoco.MjData(model), np.array((0.0, 0.0, -1.0))
    mujoco.mj_kinematics(model, data)
    for height in (place[2], HIGHEST):
        start, found = np.array((*place[:2], height)), [np.inf]
        for geom in terrain_geoms(model):
            if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_HFIELD:
                away = mujoco.mj_rayHfield(model, data, geom, start, down)
            else:
                pose = data.geom_xpos[geom], data.geom_xmat[geom]
                kind = model.geom_type[geom]
                # a plane has no end, whatever size it is drawn in
                size = model.geom_size[geom] * (kind != mujoco.mjtGeom.mjGEOM_PLANE)
                away = mujoco.mju_rayGeom(*pose, size, start, down, kind)
            found.append(away if away >= 0.0 else np.inf)
        if np.isfinite(nearest := min(found)):
            return height - float(nearest)
    return 0.0


def _base_sampling(model: mujoco.MjModel, speed: list[float]) -> BaseSampling:
    """Start of a floating base, whose joint is the model's first, at its file's place."""
    x, y, z = model.qpos0[:3].tolist()
    ground = _ground_below(model, (x, y, z))
    linear, angular = (tuple(speed[a : a + 3]) for a in (0, 3))
    return BaseSampling(
        low=(x, y, ground),
        high=(x, y, ground + 2.0 * float(_reaches(model)[0])),
        tilt=pi,
        linear_low=tuple(-v for v in linear),
        linear_high=linear,
        angular_low=tuple(-v for v in angular),
        angular_high=angular,
    )
