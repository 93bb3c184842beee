"""Which coordinates the dynamics do not depend on, found by asking the true solver.

The same random states are stepped as they are and with one coordinate moved. Where the
change of state comes out the same, the coordinate is a symmetry of the robot: it need not
be a feature. Joint limits are lifted for this test, since their effect is carried by
features of their own (the gaps to the limits).
"""

import copy
from dataclasses import dataclass

import mujoco
import numpy as np

from torchrl_nerd.geometry.kinematics import HINGE, SLIDE

TOLERANCE = 1e-9  # relative change of the step; rounding leaves about 1e-13
TRIALS = 8


@dataclass(frozen=True)
class Symmetries:
    """Scalar coordinates (hinges and slides) that the free dynamics ignore.

    | field | meaning |
    |---|---|
    | ``positions`` | qpos addresses |
    | ``velocities`` | dof addresses |
    """

    positions: frozenset[int]
    velocities: frozenset[int]


def find_symmetries(model: mujoco.MjModel, substeps: int) -> Symmetries:
    """Perturb every hinge and slide of a compiled model and compare one control step.

    One coordinate is moved and nothing else, so that only true invariances pass; the
    ground stays where it is.
    """
    free = copy.copy(model)
    for bit in ("LIMIT", "ACTUATION"):  # a torque is a torque, whatever makes it
        free.opt.disableflags |= getattr(mujoco.mjtDisableBit, f"mjDSBL_{bit}")
    rng = np.random.default_rng(0)
    positions: set[int] = set()
    velocities: set[int] = set()
    for joint in range(model.njnt):
        if int(model.jnt_type[joint]) not in (SLIDE, HINGE):
            continue
        q, v = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
        if _is_ignored(free, substeps, rng, qpos=q):
            positions.add(q)
        if _is_ignored(free, substeps, rng, qvel=v):
            velocities.add(v)
    return Symmetries(frozenset(positions), frozenset(velocities))


def _is_ignored(
    model: mujoco.MjModel,
    substeps: int,
    rng: np.random.Generator,
    qpos: int | None = None,
    qvel: int | None = None,
) -> bool:
    """True where moving one coordinate leaves the step's change of velocity alone."""
    tried = 0
    for _ in range(TRIALS):
        data = mujoco.MjData(model)
        mujoco.mj_integratePos(model, data.qpos, rng.normal(size=model.nv), 1.0)
        data.qvel = rng.normal(size=model.nv)
        data.qfrc_applied = rng.normal(size=model.nv) * model.dof_M0  # any robot's size
        moved = copy.copy(data)
        if qpos is not None:
            moved.qpos[qpos] += rng.normal()
        if qvel is not None:
            moved.qvel[qvel] += rng.normal()
        before, after = data.qvel.copy(), moved.qvel.copy()
        mujoco.mj_step(model, data, substeps)
        mujoco.mj_step(model, moved, substeps)
        if data.warning.number.any() or moved.warning.number.any():
            continue  # states that MuJoCo gave up on say nothing
        tried += 1
        change, moved_change = data.qvel - before, moved.qvel - after
        size = abs(change).max() + abs(before).max()
        if abs(change - moved_change).max() > TOLERANCE * size:
            return False
    return tried > 0
