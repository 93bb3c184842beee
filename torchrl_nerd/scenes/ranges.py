"""Ranges of training states and torques for a robot nobody has chosen them for.

Positions fill the joint limits (half a turn or a metre to both sides where there is
none). Torques are the largest the actuators can give. A joint's speed is what its own
torque reaches over half its range, less where its damping allows less, or else that at
which what hangs on it arrives from a fall over twice its reach. A floating base starts
anywhere above the ground up to twice the robot's reach, turned any way.
"""

from dataclasses import replace
from math import cos, pi, sin, sqrt
from typing import Any

import mujoco
import numpy as np
import torch

from torchrl_nerd.geometry.base import Base
from torchrl_nerd.geometry.manifold import BALL, FREE, HINGE, SLIDE
from torchrl_nerd.scenes.actuators import ActuatorController, RandomActions
from torchrl_nerd.scenes.contact_points import contact_points, ground_geoms
from torchrl_nerd.scenes.sampling import BaseSampling, Sampling, uniform

FREE_SLIDE = 1.0  # m
LEAST_REACH = 0.01  # m
LEAST_SPEED = 1.0  # m/s or rad/s: where nothing falls and nothing pushes
DRAWS = 4096  # of actions and states, to find the largest torques


def default_sampling(
    model: mujoco.MjModel, controller: ActuatorController, **ranges: Any
) -> Sampling:
    """Sampling ranges from limits and strengths of a compiled model.

    Args:
        model: compiled.
        controller: of its actuators.
        ranges: fields of `Sampling` to use in place of the default ones.
    """
    base = Base.from_model(model)
    skipped_q, skipped_v = (7, 6) if base.is_floating else (0, 0)
    low, high = (x.tolist() for x in _positions(model))
    torque = _largest_torques(model, controller, low, high)
    speed = _speeds(model, controller, torque)
    joint_speed = speed[skipped_v:].tolist()
    sampling = Sampling(
        qpos_low=tuple(low[skipped_q:]),
        qpos_high=tuple(high[skipped_q:]),
        qvel_low=tuple(-v for v in joint_speed),
        qvel_high=tuple(joint_speed),
        torque=tuple(torque),
        base=_base_sampling(model, speed) if base.is_floating else None,
        drive=None if controller.is_motor else RandomActions(controller),
        clearance=0.0 if len(contact_points(model, base)) else None,
    )
    return replace(sampling, **ranges)


def _positions(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest ``qpos``; ball joints as quaternions yet to be normalised."""
    low, high = model.qpos0.copy(), model.qpos0.copy()
    for joint in range(model.njnt):
        q, kind = int(model.jnt_qposadr[joint]), int(model.jnt_type[joint])
        limits, is_limited = model.jnt_range[joint], bool(model.jnt_limited[joint])
        if kind == BALL:  # (c, s u) with u in the unit cube turns by its limit at most
            half = min(limits[1], pi) / 2.0 if is_limited else pi / 2.0
            side = sin(half) / sqrt(3.0)
            low[q : q + 4] = (cos(half), -side, -side, -side)
            high[q : q + 4] = (cos(half), side, side, side)
        elif kind != FREE:
            free = pi if kind == HINGE else FREE_SLIDE
            low[q] = limits[0] if is_limited else low[q] - free
            high[q] = limits[1] if is_limited else high[q] + free
    return low, high


def _largest_torques(
    model: mujoco.MjModel, controller: ActuatorController, low: list, high: list
) -> list[float]:
    """Largest torque of each driven dof, at rest and at full action to either side."""
    generator = torch.Generator().manual_seed(0)
    qpos = uniform(tuple(low), tuple(high), DRAWS, generator)
    sides = uniform((-1.0,) * model.nu, (1.0,) * model.nu, DRAWS, generator).sign()
    torque = controller(sides, qpos, qpos.new_zeros(DRAWS, model.nv))
    return torque.abs().amax(0).tolist()


def _speeds(
    model: mujoco.MjModel, controller: ActuatorController, torque: list[float]
) -> np.ndarray:
    """Largest speed of every dof, m/s or rad/s, to three digits."""
    gravity, reach = float(np.linalg.norm(model.opt.gravity)), _reaches(model)
    strength = dict(zip(controller.dof_addresses, torque, strict=True))
    speeds = np.empty(model.nv)
    for dof in range(model.nv):
        joint = int(model.dof_jntid[dof])
        kind = int(model.jnt_type[joint])
        is_linear = kind == SLIDE or (
            kind == FREE and dof < model.jnt_dofadr[joint] + 3
        )
        fall = 2.0 * sqrt(gravity * reach[joint])  # over twice the reach
        speed = fall if is_linear else fall / max(reach[joint], LEAST_REACH)
        if dof in strength:
            width = 2.0 * (FREE_SLIDE if kind == SLIDE else pi)
            if model.jnt_limited[joint] and kind != BALL:
                width = float(np.ptp(model.jnt_range[joint]))
            pushed = sqrt(strength[dof] * width / model.dof_M0[dof])
            if model.dof_damping[dof] > 0.0:
                pushed = min(pushed, strength[dof] / model.dof_damping[dof])
            speed = max(speed, pushed)
        speeds[dof] = float(f"{max(speed, LEAST_SPEED):.3g}")
    return speeds


def _reaches(model: mujoco.MjModel) -> list[float]:
    """Distance from each joint to the far end of all that hangs on it, m."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    reaches = []
    for joint in range(model.njnt):
        top, reach = int(model.jnt_bodyid[joint]), 0.0
        for geom in range(model.ngeom):
            if _hangs_on(model, int(model.geom_bodyid[geom]), top):
                offset = data.geom_xpos[geom] - data.xanchor[joint]
                reach = max(reach, np.linalg.norm(offset) + model.geom_rbound[geom])
        reaches.append(float(reach))
    return reaches


def _hangs_on(model: mujoco.MjModel, body: int, top: int) -> bool:
    while body > top:  # parents come first
        body = int(model.body_parentid[body])
    return body == top


def _base_sampling(model: mujoco.MjModel, speed: np.ndarray) -> BaseSampling:
    """Start of a floating base, whose joint is the model's first."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    heights = [float(data.geom_xpos[geom, 2]) for geom in ground_geoms(model)]
    ground = min(heights, default=0.0)
    linear, angular = (tuple(speed[a : a + 3].tolist()) for a in (0, 3))
    return BaseSampling(
        low=(0.0, 0.0, ground),
        high=(0.0, 0.0, ground + 2.0 * _reaches(model)[0]),
        tilt=pi,
        linear_low=tuple(-v for v in linear),
        linear_high=linear,
        angular_low=tuple(-v for v in angular),
        angular_high=angular,
    )
