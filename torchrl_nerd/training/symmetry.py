"""Symmetries of a robot, and data augmentation by them: symmetric copies of samples.

An ant turned by 90 degrees is the same ant with its legs renumbered. Candidates are the 48
isometries that map the axes of the base frame to themselves. One is kept if it maps joints
to joints and commutes with MuJoCo's step. A symmetric copy of a token or target is a
signed permutation of its entries.
"""

from collections.abc import Iterator
from itertools import permutations, product
from typing import cast

import mujoco
import numpy as np
import torch
from tensordict import TensorDict
from tensordict.utils import NestedKey
from torch import Generator, Tensor, nn

from torchrl_nerd.configs import NO_PREDICTIONS, FeatureConfig
from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.geometry.base import keep_constants, keep_indices
from torchrl_nerd.geometry.manifold import FREE, SLIDE
from torchrl_nerd.geometry.rotations import quat_multiply
from torchrl_nerd.keys import JOINT_TORQUE, NEXT_QPOS, NEXT_QVEL, QPOS, QVEL
from torchrl_nerd.modules.nerd import TARGET, TOKEN, SceneFeatures
from torchrl_nerd.modules.symmetric import SignedCopies
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.sampling import sample_commands
from torchrl_nerd.settings import SettingError
from torchrl_nerd.training.samples import raw_tokens
from torchrl_nerd.training.signed_permutations import SignedPermutations
from torchrl_nerd.transforms import Normalize, StateDelta, Stats

PLACE_TOL = 1e-6  # m, and of a unit vector
STEP_RTOL = 1e-6  # the solver's own tolerance is 1e-8
TRIALS = 32
MAX_DEPTH = 0.01  # m that the trials reach into the ground
MIRROR = np.diag((1.0, -1.0, 1.0))  # of the world, where the base is mirrored
STATES = 512  # whose features tell which entry of a copy is which of the original
OVERSHOOT = 0.2  # of a joint's range, beyond its limits
MAX_DEPTHS = 0.01, 1.0  # m: with some of the contact points in the ground, and with all


class Isometry(nn.Module):
    """A map of states and torques that commutes with the dynamics.

    Args:
        body: ``(3, 3)``, of vectors in the axes of the floating base. Where it is a
            reflection, the world is mirrored as well, so that the base stays a rotation.
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
        body: np.ndarray,
        sources: np.ndarray,
        signs: np.ndarray,
        actuated: list[int],
    ) -> None:
        super().__init__()
        parity = np.linalg.det(body)
        world, mirror = np.eye(3), np.ones(4)
        if parity < 0.0:  # axes of rotations in the mirror's plane flip: they are axial
            world, mirror = MIRROR, np.array((1.0, -1.0, 1.0, -1.0))
        turn = np.empty(4)
        mujoco.mju_mat2Quat(turn, (world @ body.T).reshape(-1))
        keep_constants(self, world=world, mirror=mirror, turn=turn, axial=parity * body)
        keep_constants(self, joint_signs=signs[6:], motor_signs=signs[actuated])
        motors = [actuated.index(source) for source in sources[actuated]]
        keep_indices(self, joint_sources=sources[6:], motors=motors)

    def qpos(self, qpos: Tensor) -> Tensor:
        """Symmetric copy of positions ``(*batch, nq)``."""
        position, quat = qpos[..., :3] @ self.world.mT, qpos[..., 3:7] * self.mirror
        joints = qpos[..., self.joint_sources + 1] * self.joint_signs
        return torch.cat((position, quat_multiply(quat, self.turn), joints), -1)

    def qvel(self, qvel: Tensor) -> Tensor:
        """Symmetric copy of velocities ``(*batch, nv)``."""
        linear, angular = qvel[..., :3] @ self.world.mT, qvel[..., 3:6] @ self.axial.mT
        joints = qvel[..., self.joint_sources] * self.joint_signs
        return torch.cat((linear, angular, joints), -1)

    def torque(self, joint_torque: Tensor) -> Tensor:
        """Symmetric copy of joint torques ``(*batch, num_actuated)``."""
        return joint_torque[..., self.motors] * self.motor_signs

    def forward(self, data: TensorDict) -> TensorDict:
        """Symmetric copy of states or transitions: of every key that is there."""
        maps = {QPOS: self.qpos, QVEL: self.qvel, JOINT_TORQUE: self.torque}
        maps |= {NEXT_QPOS: self.qpos, NEXT_QVEL: self.qvel}
        keys = data.keys(True)
        copy = {key: apply(data[key]) for key, apply in maps.items() if key in keys}
        return TensorDict(copy, data.batch_size)


def find_isometries(scene: Scene) -> list[Isometry]:
    """The symmetry group of a robot on its ground, the identity first.

    Raises:
        ValueError: a fixed base, a ball joint, servos, or a ground that varies.
    """
    model, ground = scene.model, scene.terrain
    is_legged = scene.base.is_floating and model.nv == model.njnt + 5
    is_varied = ground is not None and ground.is_per_env
    if not is_legged or is_varied or scene.servos is not None:
        raise ValueError(
            "expected a floating base, hinges or slides, motors and one ground for "
            f"use_symmetry and copies, got '{scene.name}': train without them"
        )
    identity, *others = _candidates(scene)
    return [identity, *(other for other in others if _solver_agrees(scene, other))]


def _candidates(scene: Scene) -> Iterator[Isometry]:
    """Isometries that put joints on joints and the ground on itself."""
    actuated = list(scene.actuated)
    for order, sign in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        body = np.eye(3)[list(order)] * np.array(sign)[:, None]
        matched = _match_joints(scene.model, body)
        if matched is not None and set(matched[0][actuated]) <= set(actuated):
            yield Isometry(body, *matched, actuated)


def _match_joints(
    model: mujoco.MjModel, body: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """For each dof the one it is mapped from, and the sign; None if one has none."""
    data = mujoco.MjData(model)
    data.qpos[:] = np.eye(model.nq)[3]  # the base at the origin, not turned
    mujoco.mj_kinematics(model, data)
    sources, signs = np.arange(model.nv), np.ones(model.nv)
    scalar = [j for j in range(model.njnt) if model.jnt_type[j] != FREE]
    for joint in scalar:
        axial = 1.0 if model.jnt_type[joint] == SLIDE else np.linalg.det(body)
        anchor, axis = body @ data.xanchor[joint], axial * body @ data.xaxis[joint]
        for other in scalar:
            along = float(axis @ data.xaxis[other])
            if (
                model.jnt_type[other] == model.jnt_type[joint]
                and np.linalg.norm(anchor - data.xanchor[other]) < PLACE_TOL
                and abs(abs(along) - 1.0) < PLACE_TOL
            ):
                dof = model.jnt_dofadr[other]
                sources[dof], signs[dof] = model.jnt_dofadr[joint], np.sign(along)
                break
        else:
            return None
    return sources, signs


def _solver_agrees(scene: Scene, isometry: Isometry) -> bool:
    """Whether the isometry commutes with the step, on the ground too."""
    here = states_in_contact(scene, TRIALS, MAX_DEPTH)
    there = isometry(here)
    dynamics, ends = MujocoDynamics(scene, num_threads=1), []
    for start in (here, there):
        dynamics.reset(start)
        ends.append(dynamics.step(start, start[JOINT_TORQUE])[QVEL])
    expected = isometry.qvel(ends[0])
    change = (expected - there[QVEL]).abs().amax()
    return bool((expected - ends[1]).abs().amax() <= STEP_RTOL * (1.0 + change))


def states_in_contact(scene: Scene, count: int, max_depth: float) -> TensorDict:
    """Random states and torques ``[count]``, up to ``max_depth`` m in the ground."""
    generator = Generator().manual_seed(0)
    state, scale = scene.sample_initial(count, generator)
    draw = torch.rand(count, dtype=torch.float64, generator=generator)
    scene.place_on_terrain(state, -max_depth * draw)
    torque = sample_commands(scene.sampling, scale, 1, generator)
    return TensorDict(state, [count]).set(JOINT_TORQUE, torque[:, 0])


class Symmetry(nn.Module):
    """Isometries of a robot, the identity first, and their effect on tokens and targets.

    Raises:
        ValueError: see `find_isometries`; a feature that is zero in all of these states;
            a scene whose parameters differ from robot to robot.
    """

    def __init__(self, scene: Scene, config: FeatureConfig = NO_PREDICTIONS) -> None:
        super().__init__()
        if scene.variation is not None:
            raise ValueError(
                "expected a varied scene without use_symmetry and copies, got them"
            )
        self.isometries = nn.ModuleList(find_isometries(scene))
        encode = SceneFeatures(scene, config), StateDelta(scene)
        parts = [states_in_contact(scene, STATES // 2, depth) for depth in MAX_DEPTHS]
        states, model = cast(TensorDict, TensorDict.cat(parts)), scene.model
        share = torch.linspace(-OVERSHOOT, 1.0 + OVERSHOOT, STATES).double()
        order = Generator().manual_seed(0)
        for joint in model.jnt_limited.nonzero()[0]:  # some beyond either end
            low, high = model.jnt_range[joint]
            mixed = share[torch.randperm(STATES, generator=order)]
            states[QPOS][:, model.jnt_qposadr[joint]] = low + (high - low) * mixed
        for key in (QPOS, QVEL):  # a change between any two states will do
            states["next", key] = states[key].roll(1, 0)
        copies = [raw_tokens(*encode, isometry(states)) for isometry in self.isometries]
        still = (copies[0][0] == 0.0).all(0).nonzero()[:, 0].tolist()
        if still and len(copies) > 1:
            raise ValueError(
                f"expected random states of '{scene.name}' to fill every feature, got "
                f"none for {still}: train without use_symmetry and copies"
            )
        tokens, targets = zip(*copies, strict=True)
        self.tokens = SignedPermutations(tokens[0], tokens)
        self.targets = SignedPermutations(targets[0], targets)

    def complete(self, stats: dict[NestedKey, Stats]) -> dict[NestedKey, Stats]:
        """Statistics of tokens and targets with all their symmetric copies."""
        both = (TOKEN, self.tokens), (TARGET, self.targets)
        return {key: copies.complete(stats[key]) for key, copies in both}

    def mirrors(self, count: int) -> tuple[SignedCopies, SignedCopies]:
        """What ``count`` products of commuting mirrors make of tokens and targets.

        Raises:
            SettingError: the robot has fewer.
        """
        some = self.targets.mirrors(count)
        if some is None:
            sizes = (2**n for n in range(7) if self.targets.mirrors(2**n) is not None)
            raise SettingError(
                f"expected symmetries of {', '.join(map(str, sizes))}, which this robot's "
                f"commuting mirrors make, got {count}"
            )
        both = ((x.sources[some], x.signs[some]) for x in (self.tokens, self.targets))
        return next(both), next(both)

    def keeps(self, normalize: Normalize) -> bool:
        """Whether copies of normalised tokens and targets are those of raw ones."""
        both = (TOKEN, self.tokens), (TARGET, self.targets)
        return all(x.keep(normalize.mean(key), normalize.std(key)) for key, x in both)
