"""Which coordinates the dynamics do not depend on, found by stepping MuJoCo.

The same random states are stepped as they are and with one coordinate moved. Where the
change of state comes out the same, the coordinate is a symmetry of the robot: it need not
be a feature. Joint limits are lifted for this test, since their effect is carried by
features of their own (the gaps to the limits); so is contact, for a floating base, where
distances and normals carry it.
"""

import copy
from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np

from torchrl_nerd.geometry.base import ancestors
from torchrl_nerd.geometry.manifold import HINGE, SLIDE, joint_label
from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.scenes.contact_points import (
    ground_geoms,
    own_contacts,
    terrain_geoms,
)
from torchrl_nerd.scenes.support import DISABLE, ON_JOINT, silence_mujoco

TOLERANCE = 1e-9  # relative change of the step; rounding leaves about 1e-13
TRIALS = 8
LIMIT = int(DISABLE.mjDSBL_LIMIT)

AFFINE = int(mujoco.mjtGain.mjGAIN_AFFINE)  # of a gain; the same number of a bias

Move = Callable[[mujoco.MjData, np.random.Generator], None]


@dataclass(frozen=True)
class Effect:
    """How much a step of MuJoCo depends on one coordinate."""

    name: str  # of the joint, or which coordinate of a floating base
    key: str  # "qpos" or "qvel"
    address: int  # in it
    change: float  # of one control step when it alone is moved: relative, at worst

    @property
    def is_ignored(self) -> bool:
        """True where the step does not depend on the coordinate."""
        return self.change <= TOLERANCE


@dataclass(frozen=True)
class Symmetries:
    """Scalar coordinates (hinges and slides), and which the dynamics ignore."""

    effects: tuple[Effect, ...]

    @property
    def positions(self) -> set[int]:
        """Addresses in qpos that are ignored."""
        return {e.address for e in self.effects if e.key == QPOS and e.is_ignored}

    @property
    def velocities(self) -> set[int]:
        """Addresses in qvel that are ignored."""
        return {e.address for e in self.effects if e.key == QVEL and e.is_ignored}


def find_symmetries(
    model: mujoco.MjModel, substeps: int, has_servos: bool = False
) -> Symmetries:
    """Perturb every hinge and slide of a compiled model and compare one control step.

    One coordinate is moved and nothing else, so that only invariances of the
    dynamics pass; the ground stays where it is. Nothing is dropped where a few states do
    not show what matters: limited tendons, static shapes without features, props. A joint
    of `seldom_felt` is kept. Servos
    act in every substep; without them a torque is a torque.
    """
    if why_all_kept(model):
        return Symmetries(())
    free, rng = _without_limits(model, has_servos), np.random.default_rng(0)
    seldom = seldom_felt(model)
    effects: list[Effect] = []
    for joint in np.flatnonzero(np.isin(model.jnt_type, (SLIDE, HINGE))).tolist():
        q, v = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
        for key, address in ((QPOS, q), (QVEL, v)):
            change = _largest_change(free, substeps, rng, _shift(key, address))
            change = max(change, float(joint in seldom))
            effects.append(Effect(joint_label(model, joint), key, address, change))
    return Symmetries(tuple(effects))


def why_all_kept(model: mujoco.MjModel) -> str | None:
    """The reason, in words, where `find_symmetries` moves no coordinate; else None."""
    if model.ntree > 1:
        return "the file has several moving trees, which may push each other"
    if model.tendon_limited.any():
        return "a tendon has limits, which random states may not reach"
    if set(ground_geoms(model)) - set(terrain_geoms(model)):
        return "the robot can touch shapes that no feature shows"
    return None


def seldom_felt(model: mujoco.MjModel) -> set[int]:
    """Joints that act where few states lead: touching shapes, tendons that are slack.

    Of two shapes of the robot which may touch, those that move one against the other.
    """
    on_way = ancestors(model)[:, model.jnt_bodyid]  # (nbody, njnt)
    above = [{*np.flatnonzero(row).tolist()} for row in on_way]  # up to the world
    found: set[int] = set()
    for pair in own_contacts(model):
        one, other = (above[model.geom_bodyid[geom]] for geom in pair)
        found |= one ^ other
    low, high = model.tendon_lengthspring.T
    for tendon in np.flatnonzero((model.tendon_stiffness != 0.0) & (high > low)):
        first, count = model.tendon_adr[tendon], model.tendon_num[tendon]
        for wrap in range(first, first + count):
            kind, target = model.wrap_type[wrap], int(model.wrap_objid[wrap])
            if kind == mujoco.mjtWrap.mjWRAP_JOINT:
                found.add(target)
            elif kind == mujoco.mjtWrap.mjWRAP_SITE:
                found |= above[model.site_bodyid[target]]
    return found


def periodic_hinges(model: mujoco.MjModel, has_servos: bool) -> list[int]:
    """Addresses in ``qpos`` of hinges of which a whole turn changes nothing.

    They have no limits and no spring, and no fixed tendon, equality constraint or servo
    reads their angle.
    """
    is_periodic = (model.jnt_type == HINGE) & (model.jnt_limited == 0)
    is_periodic &= (model.jnt_stiffness == 0.0) & ~model.jnt_stiffnesspoly.any(1)
    in_tendon = model.wrap_type == mujoco.mjtWrap.mjWRAP_JOINT
    is_periodic[model.wrap_objid[in_tendon]] = False
    is_coupling = model.eq_type == mujoco.mjtEq.mjEQ_JOINT
    for ends in (model.eq_obj1id[is_coupling], model.eq_obj2id[is_coupling]):
        is_periodic[ends[ends >= 0]] = False
    if has_servos:
        for i in np.flatnonzero(np.isin(model.actuator_trntype, ON_JOINT)):
            laws = model.actuator_gaintype[i], model.actuator_biastype[i]
            places = model.actuator_gainprm[i, 1], model.actuator_biasprm[i, 1]
            if max(laws) > AFFINE or any(places):  # another law may read anything
                is_periodic[model.actuator_trnid[i, 0]] = False
    return model.jnt_qposadr[is_periodic].tolist()


def _without_limits(model: mujoco.MjModel, has_servos: bool) -> mujoco.MjModel:
    """The model without joint limits, and without actuators that are no servos."""
    free = copy.copy(model)
    free.opt.disableflags |= DISABLE.mjDSBL_LIMIT
    if not has_servos:
        free.opt.disableflags |= DISABLE.mjDSBL_ACTUATION
    return free


def _shift(key: str, address: int) -> Move:
    """Move one coordinate by a normal number."""

    def move(data: mujoco.MjData, rng: np.random.Generator) -> None:
        getattr(data, key)[address] += rng.normal()

    return move


def _largest_change(
    model: mujoco.MjModel, substeps: int, rng: np.random.Generator, move: Move
) -> float:
    """How much a move alters the step's change of velocity, relative, at worst."""
    changes: list[float] = []
    for _ in range(TRIALS):
        data = mujoco.MjData(model)
        mujoco.mj_integratePos(model, data.qpos, rng.normal(size=model.nv), 1.0)
        data.qvel = rng.normal(size=model.nv)
        data.qfrc_applied = rng.normal(size=model.nv) * model.dof_M0  # any robot's size
        if not model.opt.disableflags & DISABLE.mjDSBL_ACTUATION:
            data.ctrl = rng.normal(size=model.nu)
        moved = copy.copy(data)
        move(moved, rng)
        speed = abs(data.qvel).max()
        with silence_mujoco():
            change = _change(model, data, substeps)
            moved_change = _change(model, moved, substeps)
        if not (data.warning.number.any() or moved.warning.number.any()):
            size = speed + abs(change).max()
            changes.append(float(abs(change - moved_change).max() / size))
    return max(changes, default=1.0)  # MuJoCo resets what it warns of: not comparable


def _change(model: mujoco.MjModel, data: mujoco.MjData, substeps: int) -> np.ndarray:
    """Change of velocity ``(nv,)`` over one control step."""
    velocity = data.qvel.copy()
    mujoco.mj_step(model, data, substeps)
    return data.qvel - velocity
