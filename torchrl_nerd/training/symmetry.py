"""Symmetries of a robot: isometries under which its motion is equivariant.

An ant turned by 90 degrees is the same ant with its legs renumbered. Candidates are the 48
isometries that map the axes of the base frame to themselves. One is kept if it maps joints
to joints and MuJoCo's step of the image is the image of its step. `training.augmentation`
has their effect on tokens and targets.
"""

from collections.abc import Iterator
from itertools import permutations, product

import mujoco
import numpy as np
import torch
from tensordict import TensorDict
from torch import Generator, Tensor, nn

from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.geometry.base import keep_constants, keep_indices
from torchrl_nerd.geometry.manifold import FREE, SLIDE
from torchrl_nerd.geometry.rotations import quat_multiply
from torchrl_nerd.keys import JOINT_TORQUE, NEXT_QPOS, NEXT_QVEL, QPOS, QVEL
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.sampling import sample_commands

PLACE_TOL = 1e-6  # m, and of a unit vector
STEP_RTOL = 1e-6  # the solver's own tolerance is 1e-8
TRIALS = 32
MAX_DEPTH = 0.01  # m that the trials reach into the ground
MIRROR = np.diag((1.0, -1.0, 1.0))  # of the world, where the base is mirrored


class Isometry(nn.Module):
    """A map of states and torques that commutes with the dynamics.

    Args:
        body: ``(3, 3)``, of vectors in the axes of the floating base. Where it is a
            reflection, the world is mirrored as well, so that the base stays a rotation.
        sources: ``(nv,)``: dof v of the image is sign times dof source.
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
        """Image of positions ``(*batch, nq)``."""
        position, quat = qpos[..., :3] @ self.world.mT, qpos[..., 3:7] * self.mirror
        joints = qpos[..., self.joint_sources + 1] * self.joint_signs
        return torch.cat((position, quat_multiply(quat, self.turn), joints), -1)

    def qvel(self, qvel: Tensor) -> Tensor:
        """Image of velocities ``(*batch, nv)``."""
        linear, angular = qvel[..., :3] @ self.world.mT, qvel[..., 3:6] @ self.axial.mT
        joints = qvel[..., self.joint_sources] * self.joint_signs
        return torch.cat((linear, angular, joints), -1)

    def torque(self, joint_torque: Tensor) -> Tensor:
        """Image of joint torques ``(*batch, num_actuated)``."""
        return joint_torque[..., self.motors] * self.motor_signs

    def forward(self, data: TensorDict) -> TensorDict:
        """Image of states or transitions: of every key that is there."""
        maps = {QPOS: self.qpos, QVEL: self.qvel, JOINT_TORQUE: self.torque}
        maps |= {NEXT_QPOS: self.qpos, NEXT_QVEL: self.qvel}
        keys = data.keys(True)
        image = {key: apply(data[key]) for key, apply in maps.items() if key in keys}
        return TensorDict(image, data.batch_size)


def find_isometries(scene: Scene) -> list[Isometry]:
    """The symmetry group of a robot on its ground, the identity first.

    Raises:
        ValueError: a fixed base, a ball joint, servos, or a ground that varies.
    """
    model, ground = scene.model, scene.terrain
    is_legged = scene.base.is_floating and model.nv == model.njnt + 5
    is_varied = ground is not None and ground.is_per_row
    if not is_legged or is_varied or scene.servos is not None:
        raise ValueError(
            f"expected a floating base, hinges or slides, motors and one ground to train "
            f"with use_symmetry, got '{scene.name}': train without it"
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
    """For each dof the one it is the image of, and the sign; None if one has none."""
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
    """Whether the step of the image is the image of the step, on the ground too."""
    here = states_in_contact(scene, TRIALS, MAX_DEPTH)
    there = isometry(here)
    dynamics, ends = MujocoDynamics(scene, num_threads=1), []
    for start in (here, there):
        dynamics.reset(start)
        ends.append(dynamics.step(start, start[JOINT_TORQUE])[QVEL])
    expected = isometry.qvel(ends[0])
    change = (expected - there[QVEL]).abs().amax()
    return bool((expected - ends[1]).abs().amax() <= STEP_RTOL * (1.0 + change))


def states_in_contact(scene: Scene, rows: int, max_depth: float) -> TensorDict:
    """Random states and torques ``[rows]``, up to ``max_depth`` m in the ground."""
    generator = Generator().manual_seed(0)
    state, scale = scene.sample_initial(rows, generator)
    draw = torch.rand(rows, dtype=torch.float64, generator=generator)
    scene.place_on_terrain(state, -max_depth * draw)
    torque = sample_commands(scene.sampling, scale, 1, generator)
    return TensorDict(state, [rows]).set(JOINT_TORQUE, torque[:, 0])
