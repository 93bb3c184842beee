"""Isometries of a robot: maps of states and torques that commute with MuJoCo's step.

An ant turned by 90 degrees is the same ant with its legs renumbered. Candidates are the 48
isometries that map the axes of the base frame to themselves, or those of the world where
the base is fixed. One is kept if it maps joints to joints and shapes to shapes, and
commutes with MuJoCo's step.
"""

from collections.abc import Iterator
from itertools import permutations, product

import mujoco
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.geometry.base import keep_constants, keep_indices
from torchrl_nerd.geometry.manifold import FREE, SLIDE
from torchrl_nerd.geometry.rotations import quat_multiply
from torchrl_nerd.keys import (
    JOINT_TORQUE,
    NEXT_QPOS,
    NEXT_QVEL,
    PARAMETERS,
    QPOS,
    QVEL,
)
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.contact_points import collision_filter, own_contacts
from torchrl_nerd.scenes.penetration import touching_bodies
from torchrl_nerd.training.contact_states import states_in_contact

PLACE_TOL = 1e-6  # m, and of a unit vector
STEP_RTOL = 1e-6  # the solver's own tolerance is 1e-8
TRIALS = 128
MAX_DEPTH = 0.01  # m that the trials reach into the ground
# MuJoCo's contacts of two shapes may depend on which way up they are: of states in which
# the robot does not touch itself, before or after the step, so many are let pass
MAX_STRAYED = 1 / 16
MIRROR = np.diag((1.0, -1.0, 1.0))  # of the world, where the base is mirrored
# of a shape: what its contacts are computed with, and the radius about its center
LAW = ("condim", "priority", "friction", "solref", "solimp", "margin", "gap", "rbound")


class Isometry(nn.Module):
    """A map of states and torques that commutes with the dynamics.

    Args:
        body: ``(3, 3)``, of vectors in the axes of the floating base. Where it is a
            reflection, the world is mirrored as well, so that the base stays a rotation.
            None for a fixed base.
        sources: ``(nv,)``: dof v of the copy is sign times dof source.
        signs: ``(nv,)``.
        actuated: dofs with a motor, in the order of torques.
    """

    world: Tensor
    mirror: Tensor
    turn: Tensor
    axial: Tensor
    joint_sources: Tensor
    joint_signs: Tensor
    motors: Tensor
    motor_signs: Tensor

    def __init__(
        self,
        body: np.ndarray | None,
        sources: np.ndarray,
        signs: np.ndarray,
        actuated: list[int],
    ) -> None:
        super().__init__()
        self.base = (0, 0) if body is None else (7, 6)  # its part of qpos and qvel
        dofs = self.base[1]
        motors = [actuated.index(source) for source in sources[actuated]]
        keep_indices(self, joint_sources=sources[dofs:] - dofs, motors=motors)
        keep_constants(self, joint_signs=signs[dofs:], motor_signs=signs[actuated])
        if body is None:
            return
        parity = np.linalg.det(body)
        world, mirror = np.eye(3), np.ones(4)
        if parity < 0.0:  # axes of rotations in the mirror's plane flip: they are axial
            world, mirror = MIRROR, np.array((1.0, -1.0, 1.0, -1.0))
        turn = np.empty(4)
        mujoco.mju_mat2Quat(turn, (world @ body.T).reshape(-1))
        keep_constants(self, world=world, mirror=mirror, turn=turn, axial=parity * body)

    def qpos(self, qpos: Tensor) -> Tensor:
        """Symmetric copy of positions ``(*batch, nq)``."""
        joints = self.joints(qpos[..., self.base[0] :])
        if not any(self.base):
            return joints
        position, quat = qpos[..., :3] @ self.world.mT, qpos[..., 3:7] * self.mirror
        return torch.cat((position, quat_multiply(quat, self.turn), joints), -1)

    def joints(self, values: Tensor) -> Tensor:
        """Symmetric copy of positions or velocities of joints ``(*batch, joints)``."""
        return values[..., self.joint_sources] * self.joint_signs

    def qvel(self, qvel: Tensor) -> Tensor:
        """Symmetric copy of velocities ``(*batch, nv)``."""
        joints = self.joints(qvel[..., self.base[1] :])
        if not any(self.base):
            return joints
        linear, angular = qvel[..., :3] @ self.world.mT, qvel[..., 3:6] @ self.axial.mT
        return torch.cat((linear, angular, joints), -1)

    def torque(self, joint_torque: Tensor) -> Tensor:
        """Symmetric copy of joint torques ``(*batch, num_actuated)``."""
        return joint_torque[..., self.motors] * self.motor_signs

    def forward(self, data: TensorDict) -> TensorDict:
        """Symmetric copy of states or transitions: of every key that is there.

        Parameters stay: it is the same robot.
        """
        maps = {QPOS: self.qpos, QVEL: self.qvel, JOINT_TORQUE: self.torque}
        maps |= {NEXT_QPOS: self.qpos, NEXT_QVEL: self.qvel, PARAMETERS: nn.Identity()}
        keys = data.keys(True)
        copy = {key: apply(data[key]) for key, apply in maps.items() if key in keys}
        return TensorDict(copy, data.batch_size)


def find_isometries(scene: Scene) -> list[Isometry]:
    """The symmetry group of a robot on its ground, the identity first.

    Of a varied scene they are those that every robot has.

    Raises:
        ValueError: a ball joint, props, servos, or a ground that varies.
    """
    model, ground = scene.model, scene.terrain
    has_hinges = model.nv == model.njnt + 5 * scene.base.is_floating  # and slides
    is_varied = ground is not None and ground.is_per_env
    if not has_hinges or is_varied or scene.servos is not None:
        raise ValueError(
            "expected hinges or slides, motors and one ground for use_symmetry or "
            f"symmetries, got '{scene.name}'"
        )
    identity, *others = _candidates(scene)
    return [identity, *filter(Trial(scene).agrees, others)]


def _candidates(scene: Scene) -> Iterator[Isometry]:
    """Isometries that put joints on joints, shapes on shapes and the ground on itself.

    Joints at one place, such as the hips of a planar walker, are mapped to themselves or to
    each other.
    """
    actuated, model = list(scene.actuated), scene.model
    data, is_floating = mujoco.MjData(model), scene.base.is_floating
    data.qpos[:] = 0.0
    if is_floating:  # the base at the origin, not turned
        data.qpos[3] = 1.0
    mujoco.mj_kinematics(model, data)
    # what permutes joints leaves the mean of their places
    center = np.zeros(3) if is_floating else data.xanchor.mean(0)
    shapes = Shapes(model, data, center)
    known: list[list[float]] = []
    for order, sign in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        body = np.eye(3)[list(order)] * np.array(sign)[:, None]
        if not shapes.are_mapped(body):
            continue
        for is_swapped in (False, True):
            matched = _match_joints(model, data, center, body, is_swapped)
            if matched is None or not set(matched[0][actuated]) <= set(actuated):
                continue
            effect = [*matched[0], *matched[1], *(body.flat if is_floating else ())]
            if effect not in known:  # of a fixed base what joints do is all
                known.append(effect)
                yield Isometry(body if is_floating else None, *matched, actuated)


def _match_joints(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    center: np.ndarray,
    body: np.ndarray,
    is_swapped: bool,
) -> tuple[np.ndarray, np.ndarray] | None:
    """For each dof the one it is mapped from, and the sign; None if one has none.

    Of several at one place it is the dof itself last where ``is_swapped``, else first.
    """
    sources, signs = np.arange(model.nv), np.ones(model.nv)
    scalar = [j for j in range(model.njnt) if model.jnt_type[j] != FREE]
    places = data.xanchor - center
    for joint in scalar:
        axial = 1.0 if model.jnt_type[joint] == SLIDE else np.linalg.det(body)
        anchor, axis = body @ places[joint], axial * body @ data.xaxis[joint]
        for other in sorted(scalar, key=lambda j: (j == joint) == is_swapped):
            along = float(axis @ data.xaxis[other])
            if (
                model.jnt_type[other] == model.jnt_type[joint]
                and np.linalg.norm(anchor - places[other]) < PLACE_TOL
                and abs(abs(along) - 1.0) < PLACE_TOL
            ):
                dof = model.jnt_dofadr[other]
                sources[dof], signs[dof] = model.jnt_dofadr[joint], np.sign(along)
                break
        else:
            return None
    is_permutation = len(set(sources.tolist())) == model.nv
    return (sources, signs) if is_permutation else None


class Shapes:
    """Shapes of a robot that touch something, at the place of its joints in ``data``."""

    def __init__(
        self, model: mujoco.MjModel, data: mujoco.MjData, center: np.ndarray
    ) -> None:
        touches = collision_filter(model)
        is_own = model.body_weldid[model.geom_bodyid] > 0
        own = np.flatnonzero(is_own & touches.any(1))
        laws = [getattr(model, f"geom_{name}").reshape(model.ngeom, -1) for name in LAW]
        self.laws = np.concatenate([model.geom_type[:, None], *laws], 1)[own]
        self.places = data.geom_xpos[own] - center
        self.mutual = touches[np.ix_(own, own)]
        self.ground = np.asarray(touches[own][:, ~is_own].any(1))

    def are_mapped(self, body: np.ndarray) -> bool:
        """Whether they lie on such shapes, which touch the same.

        How they are turned, and what they weigh, is left to the trial of steps.
        """
        onto: list[int] = []
        for place, law in zip(self.places @ body.T, self.laws, strict=True):
            near = np.abs(self.places - place).max(1) < PLACE_TOL
            alike = np.isclose(self.laws, law, rtol=PLACE_TOL).all(1)
            free = [i for i in np.flatnonzero(near & alike) if i not in onto]
            if not free:
                return False
            onto.append(int(free[0]))
        is_same = np.array_equal(self.mutual, self.mutual[np.ix_(onto, onto)])
        return is_same and np.array_equal(self.ground, self.ground[onto])


class Trial:
    """Steps of MuJoCo on the ground and beyond limits, that an isometry commutes with."""

    def __init__(self, scene: Scene) -> None:
        self.dynamics = MujocoDynamics(scene, num_threads=1)
        self.start = states_in_contact(scene, TRIALS, MAX_DEPTH)
        self.end = self._step(self.start)
        self.has_own_contacts = bool(own_contacts(scene.model))
        touching = (_touch_themselves(scene, x) for x in (self.start, self.end))
        self.is_alone = ~torch.stack(list(touching)).any(0)  # (TRIALS,)

    def agrees(self, isometry: Isometry) -> bool:
        """Whether it commutes with the step; see `MAX_STRAYED`."""
        start, expected = isometry(self.start), isometry.qvel(self.end[QVEL])
        change = (expected - start[QVEL]).abs().amax()
        apart = (expected - self._step(start)[QVEL]).abs().amax(1)
        strays = apart > STEP_RTOL * (1.0 + change)  # (TRIALS,)
        if not self.has_own_contacts:
            return not strays.any()
        return bool(strays[self.is_alone].double().mean() <= MAX_STRAYED)

    def _step(self, start: TensorDictBase) -> TensorDictBase:
        self.dynamics.reset(start)
        return self.dynamics.step(start, start[JOINT_TORQUE])


def _touch_themselves(scene: Scene, state: TensorDictBase) -> Tensor:
    """Whether two of the robot's own bodies touch, ``(n,)``."""
    pairs = touching_bodies(scene.model, state[QPOS])
    return torch.tensor([any(low > 0 for low, _ in some) for some in pairs])
