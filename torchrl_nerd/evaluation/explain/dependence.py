"""Proof that nothing superfluous is kept: what each kind tells does matter to MuJoCo.

What a kind of feature stands for is altered, and nothing else, and the true control step
is compared. Limits are lifted where coordinates are moved and contact where the base is
tilted, as in `scenes/explain.py`; limits and contact themselves are altered where they
act. Distances and normals are altered by moving the robot, together with gravity, against
the ground.
"""

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import cast

import mujoco
import numpy as np
import torch
from tensordict import TensorDict
from torch import Generator, Tensor

from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.evaluation.explain import features as kinds
from torchrl_nerd.geometry.manifold import integrate_pos
from torchrl_nerd.geometry.rotations import (
    matrix_from_quat,
    quat_exp,
    quat_multiply,
    rotate,
)
from torchrl_nerd.keys import JOINT_TORQUE, QPOS, QVEL, TERRAIN
from torchrl_nerd.modules.scene_tokens import SceneTokens
from torchrl_nerd.scenes import Scene
from torchrl_nerd.transforms import StateDelta

MATTERS = 1e-6  # relative change of a step; rounding leaves about 1e-12
NEAREST = 12  # states, those deepest in the ground, at which robot or ground are moved
SHIFT, TURN = 0.02, 0.2  # m and rad: by how much, one standard deviation
PAST = 0.05  # rad or m: how far past its limit a joint is put, at most
LIMIT = int(mujoco.mjtDisableBit.mjDSBL_LIMIT)
CONTACT = int(mujoco.mjtDisableBit.mjDSBL_CONTACT)

MOVED = {
    kinds.LINEAR: "velocity of the base",
    kinds.ANGULAR: "angular velocity of the base",
    kinds.GRAVITY: "tilt of the base, without contact",
    kinds.ANGLE: "angles, without limits",
    kinds.POSITION: "positions, without limits",
    kinds.BALL: "orientations",
    kinds.SPEED: "velocities, without limits",
    kinds.GAPS: "limits switched off, beyond them",
    kinds.GATED: "velocities, beyond limits",
    kinds.TORQUE: "torques",
    kinds.DISTANCE: "robot shifted against the ground",
    kinds.NORMAL: "robot turned against the ground about its lowest point",
    kinds.VELOCITY: "velocities: what contact does to them",
    kinds.DEPTH: "contact switched off",
    kinds.PRESSED: "limits switched off, beyond them",
    kinds.FORCE: "contact switched off",
}


@dataclass(frozen=True)
class Dependence:
    """How much the true step depends on what a kind of feature tells.

    | field | meaning |
    |---|---|
    | ``kind`` | of feature |
    | ``moved`` | what was altered |
    | ``change`` | largest change of the target, relative to it and the velocity |
    """

    kind: str
    moved: str
    change: float

    @property
    def is_used(self) -> bool:
        """True where the true solver's step depends on it."""
        return self.change > MATTERS


def dependences(
    scene: Scene, states: TensorDict, generator: Generator
) -> tuple[Dependence, ...]:
    """One answer for each kind of feature in the scene's token.

    Args:
        scene: the robot.
        states: ``[rows]``, from `draw_states`.
        generator: of the alterations.
    """
    ask = _Questions(scene, states, generator)
    present = [k for k in kinds.ORDER if k in kinds.token_slices(ask.tokens)]
    return tuple(Dependence(k, MOVED[k], ask.changes[k]()) for k in present)


class _Questions:
    """The alterations, each of which gives the largest change of a true step."""

    def __init__(self, scene: Scene, states: TensorDict, generator: Generator) -> None:
        self.scene, self.states, self.generator = scene, states, generator
        self.tokens = SceneTokens(scene)
        joints, v = self.tokens.robot.joints, scene.base.dof_address
        dof_of = {q: dof for q, dof in scene.layout.linear}
        angles, positions = (
            [dof_of[q] for q in at] for at in (joints.angles, joints.positions)
        )
        ball_of = {q: dof for q, dof in scene.layout.rotations}
        balls = [ball_of[q] + i for q in joints.balls for i in range(3)]
        self.gated = [dof for _, dof in joints.gated]
        self.changes: dict[str, Callable[[], float]] = {
            kinds.LINEAR: lambda: self.moved(speed=[v, v + 1, v + 2]),
            kinds.ANGULAR: lambda: self.moved(speed=[v + 3, v + 4, v + 5]),
            kinds.GRAVITY: self.tilted,
            kinds.ANGLE: lambda: self.moved(turn=angles, lifted=LIMIT),
            kinds.POSITION: lambda: self.moved(turn=positions, lifted=LIMIT),
            kinds.BALL: lambda: self.moved(turn=balls, lifted=LIMIT),
            kinds.SPEED: lambda: self.moved(speed=joints.velocities, lifted=LIMIT),
            kinds.GAPS: self.unlimited,
            kinds.GATED: self.stopped,
            kinds.TORQUE: self.pushed,
            kinds.DISTANCE: lambda: self.against_ground(SHIFT, 0.0),
            kinds.NORMAL: lambda: self.against_ground(0.0, TURN),
            kinds.VELOCITY: self.impact,
            kinds.DEPTH: self.untouched,
            kinds.PRESSED: self.unlimited,
            kinds.FORCE: self.untouched,
        }

    def moved(
        self,
        turn: Sequence[int] = (),
        speed: Sequence[int] = (),
        lifted: int = 0,
    ) -> float:
        """Positions or velocities moved along some dofs."""
        after = self._moved(self.states, turn, speed)
        return self._compare(self.states, after, lifted, lifted)

    def tilted(self) -> float:
        """The base turned, and its velocity with it, out of reach of the ground."""
        after, base = self.states.clone(), self.scene.base
        q, v = base.qpos_address + 3, base.dof_address
        turn = quat_exp(self._normal(3))
        quat = after[QPOS][:, q : q + 4]
        after[QPOS][:, q : q + 4] = quat_multiply(turn, quat)
        after[QVEL][:, v : v + 3] = rotate(turn, after[QVEL][:, v : v + 3])
        return self._compare(self.states, after, CONTACT, CONTACT)

    def unlimited(self) -> float:
        """Joints beyond their limits, with limits and without."""
        states = self._beyond_limits()
        return self._compare(states, states, 0, LIMIT)

    def stopped(self) -> float:
        """Velocities that the free dynamics ignore, moved beyond the limits."""
        states = self._beyond_limits()
        return self._compare(states, self._moved(states, (), self.gated), 0, 0)

    def pushed(self) -> float:
        """Torques drawn anew within their ranges."""
        after = self.states.clone()
        size = after[JOINT_TORQUE].new_tensor(self.scene.sampling.torque)
        after[JOINT_TORQUE] = after[JOINT_TORQUE] + size * self._normal(len(size))
        return self._compare(self.states, after, 0, 0)

    def untouched(self) -> float:
        """Contact switched off."""
        return self._compare(self.states, self.states, 0, CONTACT)

    def impact(self) -> float:
        """What contact does to a step, at other velocities."""
        after = self._moved(self.states, (), range(self.scene.layout.nv))
        contact = [
            step(self.scene, state, 0) - step(self.scene, state, CONTACT)
            for state in (self.states, after)
        ]
        return _largest(contact[0], contact[1], self.states)

    def against_ground(self, shift: float, turn: float) -> float:
        """Robot and gravity moved as one against the ground, row by row."""
        gap = self.scene.clearances(self.states[QPOS], self.states.get(TERRAIN, None))
        lowest = gap.argmin(-1)
        rows = gap.amin(-1).argsort()[:NEAREST]
        largest = 0.0
        for row in rows.tolist():
            state = cast(TensorDict, self.states[row : row + 1])
            position, rotation = self.scene.base_pose(state[QPOS])
            points, _ = self.scene.point_kinematics(state[QPOS], state[QVEL])
            pivot = position + (rotation @ points[:, lowest[row], :, None])[..., 0]
            quat = quat_exp(turn * self._normal(3)[:1])
            to = pivot[0] + shift * self._normal(3)[0]
            scene, after = carried(self.scene, state, quat[0], pivot[0], to)
            seen = step(scene, after, 0)
            largest = max(largest, _largest(step(self.scene, state, 0), seen, state))
        return largest

    def _compare(
        self, before: TensorDict, after: TensorDict, lifted: int, lifted_after: int
    ) -> float:
        old = step(self.scene, before, lifted)
        return _largest(old, step(self.scene, after, lifted_after), before)

    def _moved(
        self, states: TensorDict, turn: Sequence[int], speed: Sequence[int]
    ) -> TensorDict:
        after, nv = states.clone(), self.scene.layout.nv
        along, faster = torch.zeros(2, nv, dtype=torch.float64)
        along[list(turn)], faster[list(speed)] = 1.0, 1.0
        tangent = along * self._normal(nv)
        after[QPOS] = integrate_pos(self.scene.layout, after[QPOS], tangent)
        after[QVEL] = after[QVEL] + faster * self._normal(nv)
        return after

    def _beyond_limits(self) -> TensorDict:
        """Every limited joint a little past its lower or upper limit."""
        states, joints = self.states.clone(), self.tokens.robot.joints
        low, high, _ = torch.tensor(joints.limits, dtype=torch.float64).unbind(-1)
        past = PAST * self._normal(len(low))
        beyond = torch.where(past < 0.0, low + past, high + past)
        states[QPOS][:, joints.limited] = beyond
        return states

    def _normal(self, width: int) -> Tensor:
        shape = len(self.states), width
        return torch.randn(shape, dtype=torch.float64, generator=self.generator)


def step(scene: Scene, states: TensorDict, lifted: int) -> Tensor:
    """The true target ``(rows, 2 nv)`` with some of MuJoCo's forces switched off."""
    model = copy.copy(scene.model)
    model.opt.disableflags |= lifted
    dynamics = MujocoDynamics(_with_model(scene, model), num_threads=1)
    ground = None if lifted & CONTACT else states.get(TERRAIN, None)
    after = dynamics.step(states.select(QPOS, QVEL), states[JOINT_TORQUE], ground)
    delta = StateDelta(scene).delta
    return delta(states[QPOS], states[QVEL], after[QPOS], after[QVEL])


def carried(
    scene: Scene, state: TensorDict, quat: Tensor, pivot: Tensor, to: Tensor
) -> tuple[Scene, TensorDict]:
    """One state's robot, and gravity, turned about a point and put elsewhere.

    Args:
        scene: robot and ground; the ground stays.
        state: ``[1]``.
        quat: ``(4,)``, the turn, world.
        pivot: ``(3,)``, m, world: what the robot is turned about.
        to: ``(3,)``, m, world: where that point comes to lie.
    """
    model, base, after = copy.copy(scene.model), scene.base, state.clone()
    turn = matrix_from_quat(quat)
    model.opt.gravity[:] = (turn @ torch.from_numpy(model.opt.gravity.copy())).numpy()
    if base.is_floating:
        q, v = base.qpos_address, base.dof_address
        qpos, qvel = after[QPOS], after[QVEL]
        qpos[:, q : q + 3] = (qpos[:, q : q + 3] - pivot) @ turn.T + to
        qpos[:, q + 3 : q + 7] = quat_multiply(quat, qpos[:, q + 3 : q + 7])
        qvel[:, v : v + 3] = qvel[:, v : v + 3] @ turn.T
        return _with_model(scene, model), after
    # the mount moves: its place is written in the frame of a body that stands still
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    parent = int(model.body_parentid[base.body])
    position, rotation = scene.fixed_base_pose
    moved = turn.numpy() @ (position - pivot.numpy()) + to.numpy()
    axes = data.xmat[parent].reshape(3, 3)
    model.body_pos[base.body] = axes.T @ (moved - data.xpos[parent])
    local = np.ascontiguousarray(axes.T @ turn.numpy() @ rotation)
    mujoco.mju_mat2Quat(model.body_quat[base.body], local.reshape(-1))
    model.body_sameframe[base.body] = 0  # or MuJoCo skips the new pose
    return _with_model(scene, model), after


def _with_model(scene: Scene, model: mujoco.MjModel) -> Scene:
    """The scene with another model, which need not be one that can be learned."""
    other = object.__new__(Scene)
    values = {field.name: getattr(scene, field.name) for field in fields(scene)}
    other.__dict__.update(values, model=model)
    return other


def _largest(before: Tensor, after: Tensor, states: TensorDict) -> float:
    """Largest difference, relative to each row's own target and velocity."""
    size = before.abs().amax(-1) + states[QVEL].abs().amax(-1)
    change = (after - before).abs().amax(-1) / size.clamp_min(1e-9)
    return float(change[change.isfinite()].max())
