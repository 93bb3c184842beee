"""What a model may have that no NeRD can learn yet, refused by name.

A NeRD sees joints, joint torques or controls, and contact with the ground. Refused is
what has a memory of its own, what acts through something else, and what makes a floating
base move otherwise here than there. Left in is what the state alone decides although no
feature names it: damping and springs, dry friction, still air or water, equality
constraints, tendons, contact between the robot's own bodies.
"""

import copy
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import mujoco
import numpy as np

from torchrl_nerd.geometry.base import Base
from torchrl_nerd.locks import fork_safe_lock
from torchrl_nerd.scenes.contact_points import body_label, ground_geoms, terrain_geoms
from torchrl_nerd.scenes.shapes import geom_kind

DISABLE = mujoco.mjtDisableBit
ON_JOINT = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
MOST_NAMED = 3  # elements of one kind in a message
MAX_CTRL = 1e10  # mjMAXVAL: MuJoCo gives up on a larger ctrl

Refusal = tuple[str, Any, Callable[[int], Any] | None]
"""What, a flag of the model or one per object, and how to get an object by its index."""


_silent: list[Any] = []  # what MuJoCo called before, once per block of `silence_mujoco`
_LOCK = fork_safe_lock()


@contextmanager
def silence_mujoco() -> Iterator[list[str]]:
    """Collect MuJoCo's warnings in a list: none on the terminal, no MUJOCO_LOG.TXT.

    What MuJoCo calls is one for all threads: the last that leaves such a block puts back
    what the first found.
    """
    warnings: list[str] = []
    with _LOCK:
        _silent.append(_silent[0] if _silent else mujoco.get_mju_user_warning())
        mujoco.set_mju_user_warning(warnings.append)
    try:
        yield warnings
    finally:
        with _LOCK:
            before = _silent.pop()
            if not _silent:
                mujoco.set_mju_user_warning(before)


def check_supported(name: str, model: mujoco.MjModel) -> None:
    """Refuse the model of scene ``name`` if it has something that no NeRD can learn.

    Raises:
        ValueError: with all reasons, each naming its elements and their bodies.
    """
    base = Base.from_model(model) if model.njnt else None
    reasons = [] if base else ["no joint"]
    is_floating = base is not None and base.is_floating
    for what, is_there, get in (*_parts(model, is_floating), *_actuators(model)):
        found = np.flatnonzero(is_there).tolist()
        if found and get is not None:
            what += f" ({', '.join(_label(model, get(i)) for i in found[:MOST_NAMED])}"
            what += f" and {len(found) - MOST_NAMED} more" * (len(found) > MOST_NAMED)
            what += ")"
        reasons += [what] if found else []
    if base and is_floating and not _moves_alike_everywhere(model, base):
        reasons.append(
            "a floating base whose motion depends on where it is or faces (wind, a "
            "spring, a constraint, an actuator)"
        )
    if reasons:
        raise ValueError(
            f"scene '{name}' is not supported: it has {'; '.join(reasons)}"
        )


def _label(model: mujoco.MjModel, element: Any) -> str:
    """Name of an element, or its number, and its body where it is on one."""
    label = f"'{element.name or element.id}'"
    body = getattr(element, "bodyid", None)
    if body is None and hasattr(element, "trntype") and element.trntype[0] in ON_JOINT:
        body = model.jnt_bodyid[[element.trnid[0]]]
    if body is None:
        return label
    label += f" of '{body_label(model, int(body[0]))}'"
    is_geom = hasattr(element, "contype")
    return label + f", a {geom_kind(model, element.id)}" * is_geom


def _parts(model: mujoco.MjModel, is_floating: bool) -> Iterator[Refusal]:
    """Everything but the actuators."""
    yield "a flexible body", model.nflex, None
    yield "a plugin", model.nplugin, None
    slides = model.geom_surfacevel.any(-1)
    yield "a surface that moves under what stands on it", slides, model.geom
    sleeps = model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP
    yield "bodies that may sleep", sleeps, None
    unknown = np.zeros(model.ngeom, bool)
    unknown[ground_geoms(model)] = is_floating
    unknown[terrain_geoms(model)] = False
    what = "ground of another shape than plane, box and height field"
    yield f"{what}, for a floating base", unknown, model.geom


def _actuators(model: mujoco.MjModel) -> Iterator[Refusal]:
    """Actuators whose force a state and a held control do not tell."""
    get = model.actuator
    has_state = model.actuator_dyntype != mujoco.mjtDyn.mjDYN_NONE
    yield "an actuator with a state of its own", has_state, get
    yield "a delayed actuator", model.actuator_delay, get
    is_called = model.actuator_gaintype == mujoco.mjtGain.mjGAIN_USER
    is_called |= model.actuator_biastype == mujoco.mjtBias.mjBIAS_USER
    yield "an actuator whose force a callback computes", is_called, get
    is_single = (model.actuator_ctrlnum == 1) & (model.actuator_outnum == 1)
    yield "an actuator of several controls", ~is_single, get
    is_wild = ~(abs(model.actuator_ctrlrange) <= MAX_CTRL).all(1)  # NaN is
    yield f"an actuator with a control range beyond {MAX_CTRL:g}", is_wild, get
    is_off = [bool(model.opt.disableactuator & 1 << g) for g in model.actuator_group]
    yield "a disabled actuator", is_off, get
    all_off = model.nu and model.opt.disableflags & DISABLE.mjDSBL_ACTUATION
    yield "actuators that are disabled", all_off, None


def unit_gravity(model: mujoco.MjModel) -> np.ndarray:
    """Direction of gravity ``(3,)``; where there is none, against z."""
    size = np.linalg.norm(model.opt.gravity)
    return model.opt.gravity / size if size else np.array([0.0, 0.0, -1.0])


def _moves_alike_everywhere(model: mujoco.MjModel, base: Base) -> bool:
    """True where a free flight, moved and turned about gravity, stays the same."""
    flight = copy.copy(model)
    flight.opt.disableflags |= DISABLE.mjDSBL_CONTACT
    # forces decide; an iterative integrator is exact to its solver's tolerance alone
    flight.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
    flight.opt.solver, flight.opt.iterations = mujoco.mjtSolver.mjSOL_NEWTON, 100
    rng, yaw = np.random.default_rng(0), np.append(0.8, 0.6 * unit_gravity(model))
    q, v = base.qpos_address, base.dof_address
    data = mujoco.MjData(flight)
    mujoco.mj_integratePos(flight, data.qpos, rng.normal(size=model.nv), 1.0)
    data.qpos[q : q + 3] = rng.normal(size=3)  # far off, digits are lost
    data.qvel = rng.normal(size=model.nv)
    data.ctrl = rng.normal(size=model.nu)
    moved = copy.copy(data)
    moved.qpos[q : q + 3] += 10.0 * rng.normal(size=3)
    mujoco.mju_mulQuat(moved.qpos[q + 3 : q + 7], yaw, data.qpos[q + 3 : q + 7])
    mujoco.mju_rotVecQuat(moved.qvel[v : v + 3], data.qvel[v : v + 3], yaw)
    for state in (data, moved):
        mujoco.mj_step(flight, state)
    expected = data.qvel.copy()
    mujoco.mju_rotVecQuat(expected[v : v + 3], data.qvel[v : v + 3], yaw)
    return abs(moved.qvel - expected).max() < 1e-9 * (1.0 + abs(expected).max())
