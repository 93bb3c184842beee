"""Symmetries of a robot: isometries under which its motion is equivariant.

An ant turned by 90 degrees is the same ant with its legs renumbered. Candidates are the 48
isometries that map the axes of the base frame to themselves. One is kept if it maps joints
to joints and MuJoCo's step of the image is the image of its step.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import permutations, product

import mujoco
import numpy as np
import torch
from tensordict import TensorDict
from torch import Generator, Tensor

from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.geometry.manifold import SLIDE
from torchrl_nerd.geometry.rotations import quat_multiply
from torchrl_nerd.geometry.surfaces import PLANE_PARAMETERS
from torchrl_nerd.keys import JOINT_TORQUE, NEXT_QPOS, NEXT_QVEL, QPOS, QVEL, TERRAIN
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.sampling import sample_torque

PLACE_TOL = 1e-6  # m, and of a unit vector
STEP_RTOL = 1e-6  # the solver's own tolerance is 1e-8
TRIALS = 32
MAX_DEPTH = 0.01  # m that the trials reach into the ground
MIRROR = np.diag((1.0, -1.0, 1.0))  # of the world, where the base is mirrored


@dataclass(frozen=True, eq=False)
class Isometry:
    """A map of states, torques and terrain that commutes with the dynamics."""

    scene: Scene
    world: Tensor  # (3, 3): of velocities, and of positions about `center`
    center: Tensor  # (3,), m
    body: Tensor  # (3, 3): of vectors in the axes of a floating base
    turn: Tensor  # (4,): what is left of it where the world is mirrored back
    sources: Tensor  # (nv,): joint v's image is sign times joint source
    signs: Tensor  # (nv,)
    motors: Tensor  # (num_actuated,): sources among the actuated dofs

    @property
    def is_identity(self) -> bool:
        """True for the map that changes nothing."""
        return bool(torch.equal(self.body, torch.eye(3).to(self.body)))

    def moves_like(self, other: "Isometry") -> bool:
        """Whether both map the robot's states alike, as across the plane it moves in."""
        names = (
            "sources",
            "signs",
            *(("body",) if self.scene.base.is_floating else ()),
        )
        return all(torch.equal(getattr(self, k), getattr(other, k)) for k in names)

    def qpos(self, qpos: Tensor) -> Tensor:
        """Image of positions ``(*batch, nq)``."""
        extra = qpos.shape[-1] - len(self.sources)  # a quaternion's fourth number
        free = 7 * self.scene.base.is_floating
        sources, signs = self.sources[free - extra :], self.signs[free - extra :]
        joints = qpos[..., sources + extra] * signs
        if not free:
            return joints
        position = self.center + (qpos[..., :3] - self.center) @ self.world.mT
        quat = qpos[..., 3:7]
        if torch.det(self.world) < 0.0:  # axes are axial: those in the mirror stay
            quat = quat * quat.new_tensor((1.0, -1.0, 1.0, -1.0))
        return torch.cat((position, quat_multiply(quat, self.turn), joints), -1)

    def qvel(self, qvel: Tensor) -> Tensor:
        """Image of velocities ``(*batch, nv)``."""
        joints = qvel[..., self.sources] * self.signs
        if not self.scene.base.is_floating:
            return joints
        linear = qvel[..., :3] @ self.world.mT
        angular = torch.det(self.body) * qvel[..., 3:6] @ self.body.mT
        return torch.cat((linear, angular, joints[..., 6:]), -1)

    def torque(self, joint_torque: Tensor) -> Tensor:
        """Image of joint torques ``(*batch, num_actuated)``."""
        signs = self.signs[self.scene.actuated]
        return joint_torque[..., self.motors] * signs

    def terrain(self, terrain: Tensor) -> Tensor:
        """Image of the planes of each row, ``(*batch, terrain.size)``."""
        parts = []
        for plane in terrain.split(PLANE_PARAMETERS, -1):
            normal = plane[..., :3] @ self.world.mT
            shift = ((normal - plane[..., :3]) @ self.center)[..., None]
            parts.append(torch.cat((normal, plane[..., 3:] + shift), -1))
        return torch.cat(parts, -1)

    def __call__(self, data: TensorDict) -> TensorDict:
        """Image of states or transitions: of every key that is there."""
        maps = {QPOS: self.qpos, QVEL: self.qvel, JOINT_TORQUE: self.torque}
        maps |= {NEXT_QPOS: self.qpos, NEXT_QVEL: self.qvel, TERRAIN: self.terrain}
        keys = data.keys(True)
        image = {key: apply(data[key]) for key, apply in maps.items() if key in keys}
        return TensorDict(image, data.batch_size)

    def to(self, device: torch.device) -> "Isometry":
        """The same on another device."""
        tensors = {k: v for k, v in vars(self).items() if k != "scene"}
        return Isometry(self.scene, **{k: v.to(device) for k, v in tensors.items()})


def find_isometries(scene: Scene) -> tuple[Isometry, ...]:
    """The symmetry group of a robot on its ground, the identity first.

    Only the identity for robots with ball joints and for grounds other than planes.
    """
    identity, *others = sorted(_candidates(scene), key=lambda c: not c.is_identity)
    found = [identity]
    for candidate in others:
        is_new = not any(candidate.moves_like(other) for other in found)
        if is_new and _solver_agrees(candidate):
            found.append(candidate)
    return tuple(found)


def _candidates(scene: Scene) -> Iterator[Isometry]:
    """Isometries that put joints on joints, gravity on gravity and ground on ground."""
    model, data = scene.model, mujoco.MjData(scene.model)
    data.qpos[:] = 0.0
    if scene.base.is_floating:
        data.qpos[3] = 1.0
    mujoco.mj_kinematics(model, data)
    center = np.zeros(3) if scene.base.is_floating else scene.fixed_base_pose[0]
    has_ball = model.nv - model.njnt != 5 * scene.base.is_floating
    for order, sign in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        body = np.eye(3)[list(order)] * np.array(sign)[:, None]
        is_identity = np.array_equal(body, np.eye(3))
        world = body
        if scene.base.is_floating:
            world = np.eye(3) if np.linalg.det(body) > 0.0 else MIRROR
        if not is_identity and (has_ball or not _keeps_place(scene, world)):
            continue
        matched = _match_joints(model, data, body, center)
        if is_identity:
            matched = np.arange(model.nv), np.ones(model.nv)
        if matched is None:
            continue
        sources, signs = matched
        driven = [s for s in sources[scene.actuated] if s in scene.actuated]
        motors = [scene.actuated.index(s) for s in driven]
        if len(motors) < len(scene.actuated):
            continue
        quat = np.empty(4)
        mujoco.mju_mat2Quat(quat, (world @ body.T).reshape(-1))
        numbers = (world, center, body, quat)
        yield Isometry(
            scene,
            *(torch.as_tensor(x, dtype=torch.float64).clone() for x in numbers),
            sources=torch.as_tensor(sources),
            signs=torch.as_tensor(signs),
            motors=torch.as_tensor(motors, dtype=torch.long),
        )


def _keeps_place(scene: Scene, world: np.ndarray) -> bool:
    """Whether gravity and what does not move of the ground stay as they are."""
    gravity, ground = scene.model.opt.gravity, scene.terrain
    if not np.allclose(world @ gravity, gravity):
        return False
    if ground is None or np.array_equal(world, np.eye(3)):
        return True
    if ground.is_per_row:
        return len(ground.planes) == len(ground.surfaces)
    plane = ground.fixed_plane
    return plane is not None and np.allclose(world @ plane[:3], plane[:3])


def _match_joints(
    model: mujoco.MjModel, data: mujoco.MjData, body: np.ndarray, center: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """For each dof the one it is the image of, and the sign; None if one has none."""
    sources, signs = np.arange(model.nv), np.ones(model.nv)
    scalar = [j for j in range(model.njnt) if model.jnt_type[j] != 0]
    for joint in scalar:
        is_slide = model.jnt_type[joint] == SLIDE
        axial = 1.0 if is_slide else np.linalg.det(body)
        anchor = center + body @ (data.xanchor[joint] - center)
        axis = axial * body @ data.xaxis[joint]
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


def _solver_agrees(isometry: Isometry) -> bool:
    """Whether the step of the image is the image of the step, on the ground too."""
    scene = isometry.scene
    here = states_in_contact(scene, TRIALS, MAX_DEPTH)
    there = isometry(here)
    dynamics = MujocoDynamics(scene, num_threads=1)
    ends = []
    for start in (here, there):
        dynamics.reset(start)
        ends.append(dynamics.step(start, start[JOINT_TORQUE], start.get(TERRAIN, None)))
    expected, found = isometry.qvel(ends[0][QVEL]), ends[1][QVEL]
    change = (expected - there[QVEL]).abs().amax()
    return bool((expected - found).abs().amax() <= STEP_RTOL * (1.0 + change))


def states_in_contact(scene: Scene, rows: int, max_depth: float) -> TensorDict:
    """Random states and torques ``[rows]``, up to ``max_depth`` m in the ground."""
    generator = Generator().manual_seed(0)
    state, scale = scene.sample_initial(rows, generator)
    draw = torch.rand(rows, dtype=torch.float64, generator=generator)
    scene.place_on_terrain(state, -max_depth * draw)
    torque = sample_torque(scene.sampling, scale, 1, generator)
    return TensorDict(state, [rows]).set(JOINT_TORQUE, torque[:, 0])
