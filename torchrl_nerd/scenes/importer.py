"""Third-party robots: MJCF files, the dm_control suite, Gymnasium's MuJoCo environments.

All give a compiled model and a control step; the controller and the ranges of training
follow from the model. Positions fill the joint limits (half a turn or a metre to both sides
where there is none). Torques are the largest the actuators can give. A joint's speed is
what its own torque reaches over half its range, less where its damping allows less, or else
that at which what hangs on it arrives from a fall over twice its reach. A floating base
starts anywhere above the ground up to twice the robot's reach, turned any way.
"""

import ast
import os
import warnings
from dataclasses import fields, replace
from importlib.util import find_spec
from math import cos, isfinite, pi, sin, sqrt
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
import torch

from torchrl_nerd.geometry.base import Base
from torchrl_nerd.geometry.manifold import BALL, FREE, HINGE, SLIDE
from torchrl_nerd.scenes.contact_points import contact_points, terrain_geoms
from torchrl_nerd.scenes.controllers import ActuatorController
from torchrl_nerd.scenes.sampling import BaseSampling, Sampling, uniform

if TYPE_CHECKING:
    from dm_control.rl.control import Environment

CONTROL_STEP = 0.02  # s, where nobody says
FREE_SLIDE = 1.0  # m
PROP_ROOM = 0.1  # m: how far from its place a prop starts at least
LEAST_REACH = 0.01  # m
START_PENETRATION = 1e-3  # m: about what a resting robot's soft contacts give
LEAST_SPEED = 1.0  # m/s or rad/s: where nothing falls and nothing pushes
DRAWS = 4096  # of actions and states, to find the largest torques


def read_mjcf(
    path: Path, control_step: float | None, terrain: str | None = None
) -> tuple[mujoco.MjModel, int]:
    """Model and substeps of an MJCF file, at a control step or the one nearest to 0.02 s.

    With terrain ``"plane"`` level ground is added to it.

    Raises:
        ValueError: in one sentence, no file, MuJoCo's complaint, a control step of no
            whole number of timesteps, or ground that cannot be added.
    """
    if not path.is_file():
        raise ValueError(f"expected an MJCF file, found none at {path}")
    if terrain not in (None, "plane"):
        raise ValueError(f"expected terrain 'plane' or None, got {terrain!r}")
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        complaint = " ".join(str(error).split())
        raise ValueError(f"MuJoCo cannot compile {path}: {complaint}") from None
    if terrain is not None:
        if terrain_geoms(model):
            raise ValueError(f"expected no ground beside a plane in {path}, got some")
        spec = mujoco.MjSpec.from_file(str(path))
        plane = mujoco.mjtGeom.mjGEOM_PLANE
        spec.worldbody.add_geom(type=plane, size=(0.0, 0.0, 1.0))
        model = spec.compile()
    timestep = model.opt.timestep
    if control_step is None:
        return model, max(1, round(CONTROL_STEP / timestep))
    is_number = isinstance(control_step, Real) and isfinite(control_step)
    substeps = round(control_step / timestep) if is_number else 0
    if substeps < 1 or abs(substeps * timestep - control_step) > 1e-9:
        raise ValueError(
            f"expected a control step of whole timesteps of {timestep} s, "
            f"got {control_step!r} s"
        )
    return model, substeps


def load_suite(domain: str, task: str) -> "Environment":
    """The dm_control suite's own environment of a task.

    dm_control is imported here, on first use: it looks for a display and says so.

    Raises:
        ValueError: no such domain or task.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from dm_control import suite
    if (domain, task) not in suite.ALL_TASKS:
        tasks = [t for d, t in suite.ALL_TASKS if d == domain]
        known = tasks or dict.fromkeys(d for d, _ in suite.ALL_TASKS)
        raise ValueError(
            f"unknown {'task' if tasks else 'domain'} in 'dm_control/{domain}-{task}', "
            f"expected one of {', '.join(known)}"
        )
    return suite.load(domain, task, task_kwargs={"random": 0})


def gymnasium_file(env_id: str) -> tuple[Path, int]:
    """MJCF file and frame skip of a registered environment.

    Both are read from the source: importing it needs OpenGL.

    Raises:
        ValueError: no Gymnasium, no such environment, or one that names no MJCF file.
    """
    try:
        from gymnasium.envs.registration import registry
    except ImportError:
        raise ValueError(
            "expected Gymnasium to read its robots: `pip install gymnasium`"
        ) from None
    if env_id not in registry:
        raise ValueError(f"unknown environment '{env_id}' of Gymnasium")
    spec = registry[env_id]
    settings, source = _constructor_defaults(str(spec.entry_point))
    settings |= spec.kwargs
    if not {"xml_file", "frame_skip"} <= settings.keys():
        raise ValueError(
            f"expected an environment of Gymnasium with an xml_file and a frame_skip, "
            f"as those of version 5 have, got '{env_id}'"
        )
    file = os.path.expanduser(settings["xml_file"])
    return source.parent / "assets" / file, int(settings["frame_skip"])


def _constructor_defaults(entry_point: str) -> tuple[dict[str, Any], Path]:
    """Plain default arguments of the class at ``module:Class``, and its source file."""
    module, _, name = entry_point.partition(":")
    package, *rest = module.split(".")
    found = find_spec(package)
    folders = found.submodule_search_locations if found else None
    source = Path(folders[0], *rest).with_suffix(".py") if folders else Path()
    tree = ast.parse(source.read_text(encoding="utf-8") if source.is_file() else "")
    defaults = {}
    for node in ast.walk(tree):
        if not isinstance(node, ast.ClassDef) or node.name != name:
            continue
        for part in node.body:
            if isinstance(part, ast.FunctionDef) and part.name == "__init__":
                names, values = part.args.args, part.args.defaults
                pairs = zip(names[len(names) - len(values) :], values, strict=True)
                plain = ((n.arg, v) for n, v in pairs if isinstance(v, ast.Constant))
                defaults = {n: v.value for n, v in plain}
    return defaults, source


def default_sampling(
    model: mujoco.MjModel, controller: ActuatorController, **ranges: Any
) -> Sampling:
    """Sampling ranges from limits and strengths of a compiled model.

    ``ranges``: fields of `Sampling` to use in place of the default ones; ValueError where
    one is none.
    """
    known = [field.name for field in fields(Sampling)]
    if unknown := [name for name in ranges if name not in known]:
        raise ValueError(
            f"expected ranges among {', '.join(known)}, got '{unknown[0]}'"
        )
    base = Base.from_model(model)
    # a floating base has ranges of its own where it is the first joint
    is_first = base.is_floating and base.dof_address == 0
    skipped_q, skipped_v = (7, 6) if is_first else (0, 0)
    low, high = (tuple(x.tolist()) for x in _positions(model))
    torque = _largest_torques(model, controller, low, high)
    speed = _speeds(model, controller, torque).tolist()
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


def _positions(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
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
    gravity, reach = float(np.linalg.norm(model.opt.gravity)), _reaches(model)
    strength = dict(zip(controller.dof_addresses, torque, strict=True))
    speeds = np.empty(model.nv)
    for dof in range(model.nv):
        joint = int(model.dof_jntid[dof])
        kind = int(model.jnt_type[joint])
        is_linear = kind == SLIDE
        is_linear |= kind == FREE and dof < model.jnt_dofadr[joint] + 3
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
    reaches = [0.0] * model.njnt
    for geom in range(model.ngeom):
        body = int(model.geom_bodyid[geom])
        while body:  # every joint between the shape and the world
            start = int(model.body_jntadr[body])
            for joint in range(start, start + int(model.body_jntnum[body])):
                offset = data.geom_xpos[geom] - data.xanchor[joint]
                reach = float(np.linalg.norm(offset) + model.geom_rbound[geom])
                reaches[joint] = max(reaches[joint], reach)
            body = int(model.body_parentid[body])
    return reaches


def _base_sampling(model: mujoco.MjModel, speed: list[float]) -> BaseSampling:
    """Start of a floating base, whose joint is the model's first."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    heights = [float(data.geom_xpos[geom, 2]) for geom in terrain_geoms(model)]
    ground = min(heights, default=0.0)
    linear, angular = (tuple(speed[a : a + 3]) for a in (0, 3))
    return BaseSampling(
        low=(0.0, 0.0, ground),
        high=(0.0, 0.0, ground + 2.0 * _reaches(model)[0]),
        tilt=pi,
        linear_low=tuple(-v for v in linear),
        linear_high=linear,
        angular_low=tuple(-v for v in angular),
        angular_high=angular,
    )
