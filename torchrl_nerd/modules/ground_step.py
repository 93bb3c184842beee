"""A control step of a robot on the ground: two looks at the robot, many at its springs.

MuJoCo looks at everything anew in every substep: mass matrix, bias forces, where points
and axes are. Within a control step all that changes little and smoothly; what does not is
the push of stiff springs and dampers, at contacts and limits, which is a cheap law of depth
and speed. So the robot is looked at twice, at the start and at the mean time of the
substeps, where a first march through half of them ends. Then all substeps are made, as
MuJoCo makes them, with points whose levers and free accelerations change along the line
through both looks, and the mass matrix of the second one.

Where that is too dear, one look has to do, at the mean time of the substeps, to where the
velocity of the start leads, and some substeps at once.
"""

from typing import NamedTuple

import mujoco
import numpy as np
import torch
from torch import Tensor, nn

from torchrl_nerd.geometry.base import BasePose
from torchrl_nerd.geometry.constants import keep_constants
from torchrl_nerd.geometry.elimination import Limbs, inverted, times
from torchrl_nerd.geometry.free_motion import FreeMotion, rows_last
from torchrl_nerd.geometry.joint_axes import JointAxes
from torchrl_nerd.geometry.kinematics import PointKinematics, cross
from torchrl_nerd.geometry.manifold import integrate_pos
from torchrl_nerd.modules.free_step import expect_none, untold_pushes
from torchrl_nerd.modules.springs import ContactSprings, LimitSprings
from torchrl_nerd.scenes.contact_points import shape_points
from torchrl_nerd.scenes.scene import Scene
from torchrl_nerd.scenes.terrain_distance import TerrainDistance

EULER = mujoco.mjtIntegrator.mjINT_EULER


class _Look(NamedTuple):
    """A robot at one time, in its base's axes there; rows last."""

    levers: Tensor  # (3, P, C, N): what each of its C rates moves a point by, m or 1
    normal: Tensor  # (3, P, N)
    depth: Tensor  # (P, N), m
    free: Tensor  # (nv, N): acceleration without springs
    inverse: Tensor  # (nv, nv, N), of the mass matrix
    rotation: Tensor  # (N, 3, 3), of the base


class _March(NamedTuple):
    """Where a march through substeps has come to; rows last."""

    speed: Tensor  # (nv, N)
    moved: Tensor  # (nv, N), a tangent


class GroundStep(nn.Module):
    """The next state, near to what MuJoCo's substeps make of it.

    Args:
        scene: a robot of hinges and slides, on a free base or a fixed one, over a ground,
            whose contacts and limits are springs and dampers, see `scenes.penalty`.
        looks: one or two.
        stride: how many of MuJoCo's substeps are made as one.

    Raises:
        ValueError: in one sentence, another robot, or another number of looks.
    """

    joints: Tensor
    rates: Tensor
    limited: Tensor
    limited_places: Tensor
    reaches: Tensor
    has: Tensor
    radii: Tensor
    is_slide: Tensor

    def __init__(self, scene: Scene, looks: int = 2, stride: int = 1) -> None:
        super().__init__()
        model = scene.model
        if looks not in (1, 2):
            raise ValueError(f"expected one look or two, got {looks}")
        expect_none(scene, untold_pushes(scene))
        if scene.terrain is None:
            raise ValueError(f"expected a ground to step on, got scene '{scene.name}'")
        if model.opt.integrator != EULER:
            found = mujoco.mjtIntegrator(model.opt.integrator).name
            raise ValueError(
                f"expected substeps of mjINT_EULER, got {found} in scene '{scene.name}'"
            )
        own = round(scene.control_step / float(model.opt.timestep))
        self.looks, self.substeps = looks, max(1, own // stride)
        self.step_size = scene.control_step / self.substeps
        self.ahead = 0.5 * (self.substeps - 1) * self.step_size  # s, of their mean time
        axes, points = JointAxes.of(model, scene.base), scene.contacts
        self.num_points, self.num_axes = len(points), len(axes.joints)
        self.contact, self.limit = ContactSprings(scene), LimitSprings(model, axes)
        self.limbs = Limbs.of(model)
        self.motion = FreeMotion(model, scene.base, axes, scene.actuated)
        bodies = points.bodies + axes.bodies + self.motion.bodies
        places = points.positions, axes.positions, self.motion.positions
        places = np.concatenate(places)
        self.kinematics = PointKinematics(model, scene.base, bodies, places)
        self.pose, self.layout = BasePose(scene.base, scene.mount), scene.layout
        self.ground = TerrainDistance(scene.terrain, float(points.margins.max()))
        self.whole = 3 * scene.base.is_floating  # rates that turn all there is
        limited = [2 * self.whole + joint for joint in self.limit.joints]
        # rims of several bodies in one place push together, each turned by its own joints
        carried = points.merged @ axes.carries(shape_points(model)[0]).T
        carried /= points.merged.sum(1, keepdims=True)  # (P, J)
        longest = int((carried > 0.0).sum(1).max(initial=0))
        # a point's own joints first, then others, which have no lever, to fill the row
        joints = np.argsort(-carried, 1, kind="stable")[:, :longest]
        self.shape = joints.shape
        whole = range(self.whole, 2 * self.whole)
        rates = [[*whole, *(2 * self.whole + row)] for row in joints]
        pushed = [*np.concatenate(rates), *limited]
        reaches = np.zeros((model.nv, len(pushed)))
        reaches[np.array(pushed, int), range(len(pushed))] = 1.0
        places = [self.motion.qpos_addresses[joint] for joint in self.limit.joints]
        # as tensors, since compiled code takes long lists for questions of each entry
        for name, numbers in (
            ("joints", joints.flatten()),
            ("rates", np.concatenate(rates)),
            ("limited", limited),
            ("limited_places", places),
        ):
            index = torch.from_numpy(np.array(numbers, dtype=np.int64))
            self.register_buffer(name, index, persistent=False)
        keep_constants(
            self,
            reaches=reaches,
            has=np.take_along_axis(carried, joints, 1)[..., None],
            radii=points.radii[:, None],
            is_slide=axes.is_slide[joints][..., None],
        )

    def forward(
        self,
        qpos: Tensor,
        qvel: Tensor,
        joint_torque: Tensor,
        terrain: Tensor | None = None,
        dtype: torch.dtype = torch.float64,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The next state, and by how much the velocity at the last look was wrong.

        Args:
            qpos: ``(*batch, nq)``.
            qvel: ``(*batch, nv)``.
            joint_torque: ``(*batch, num_actuated)``, held over the step.
            terrain: ``(*batch, terrain.size)``; None for the scene's own ground.
            dtype: of the springs; all else is float64.

        Returns:
            The next ``qpos`` and ``qvel``, and the velocity that the substeps have at the
            time of the last look less the one that it was taken with, ``(*batch, nv)``, a
            floating base's in its own axes there.
        """
        batch, state = qpos.shape[:-1], (qpos, qvel, joint_torque)
        qpos, qvel, joint_torque = (x.flatten(0, -2) for x in state)
        ground = None if terrain is None else terrain.flatten(0, -2)
        given = joint_torque, ground, dtype
        joints = qpos.mT[self.limited_places].to(dtype)
        if self.looks == 1:
            start, guess = None, qvel
            place = integrate_pos(self.layout, qpos, self.ahead * qvel)
        else:
            start = self._look(qpos, qvel, *given)
            speed = self._turned(qvel.mT, start.rotation.mT).to(dtype)
            marches = self._march(start, None, speed, joints, self.substeps // 2)
            place, guess = self._moved(qpos, self._middle(marches), start.rotation)
        look = self._look(place, guess, *given)
        speed = self._turned(qvel.mT, look.rotation.mT).to(dtype)
        if start is None:  # back to the depths of the start
            rising = (self._velocity(look.levers, speed) * look.normal).sum(0)
            look = look._replace(depth=look.depth + self.ahead * rising)
        marches = self._march(look, start, speed, joints, self.substeps)
        guess = self._turned(guess.mT, look.rotation.mT)
        wrong = (self._middle(marches).speed - guess).mT
        found = *self._moved(qpos, marches[-1], look.rotation), wrong
        return tuple(x.unflatten(0, batch) for x in found)  # pyright: ignore

    def _middle(self, marches: list[_March]) -> _March:
        """Where a march is at the mean of the times at which substeps begin."""
        before, after = marches[(self.substeps - 1) // 2], marches[self.substeps // 2]
        pairs = zip(before, after, strict=True)
        return _March(*(torch.lerp(one, other, 0.5) for one, other in pairs))

    def _moved(
        self, qpos: Tensor, march: _March, rotation: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The state ``(N, nq)``, ``(N, nv)`` where a march has come to."""
        speed, moved = (self._turned(x.to(qpos), rotation).mT for x in march)
        return integrate_pos(self.layout, qpos, moved), speed

    def _look(
        self,
        qpos: Tensor,
        qvel: Tensor,
        joint_torque: Tensor,
        terrain: Tensor | None,
        dtype: torch.dtype,
    ) -> _Look:
        found, _ = self.kinematics(qpos, qvel)
        sizes = self.num_points, 2 * self.num_axes
        points, places, corners = found.split(
            (*sizes, found.shape[-2] - sum(sizes)), -2
        )
        position, rotation = self.pose(qpos)
        distance, normal = self.ground(points, terrain, position, rotation)
        matrix, push = self.motion.equation(
            qpos, qvel, joint_torque, rotation, corners, places, 2.0 * self.step_size
        )
        inverse, free = inverted(matrix, push, self.limbs)
        depth, normal = self.radii - distance.mT, rows_last(normal, 2)
        # spheres touch where they are halfway into the ground
        points = (
            rows_last(points, 2) - (self.radii - 0.5 * depth.clamp_min(0.0)) * normal
        )
        levers = self._levers(points, rows_last(places, 2))
        parts = levers, normal, depth, free, inverse
        levers, normal, depth, free, inverse = (x.to(dtype).contiguous() for x in parts)
        return _Look(levers, normal, depth, free, inverse, rotation)

    def _levers(self, points: Tensor, places: Tensor) -> Tensor:
        """What each of its C rates moves a point by, ``(3, P, C, N)``."""
        anchor, tip = places.chunk(2, 1)
        axis, anchor = (
            x[:, self.joints].unflatten(1, self.shape) for x in (tip - anchor, anchor)
        )
        turning = cross(axis, points[:, :, None] - anchor)
        levers = self.has * torch.where(self.is_slide > 0.0, axis, turning)
        if not self.whole:
            return levers
        one = torch.eye(3, dtype=points.dtype, device=points.device)
        whole = cross(one[:, None, :, None], points[:, :, None])
        return torch.cat((whole, levers), 2)

    def _march(
        self,
        look: _Look,
        start: _Look | None,
        speed: Tensor,
        joints: Tensor,
        count: int,
    ) -> list[_March]:
        """Where ``count`` substeps lead to, one by one, from nowhere on.

        Args:
            look: in whose axes the march is, and with whose mass matrix.
            start: another one, at the start, whence levers and free accelerations change
                to ``look``, where it is the mean time of all substeps; None: they stay.
            speed: at the start, ``(nv, N)``.
            joints: where those with limits are, ``(L, N)``.
            count: of substeps.
        """
        step, levers, normal, depth, free, inverse, _ = self.step_size, *look
        bend, drift = None, None
        if start is not None:
            turn = look.rotation.mT @ start.rotation
            levers, normal = (_rotated(x, turn) for x in (start.levers, start.normal))
            free, depth = self._turned(start.free, turn), start.depth
            share = 2.0 / max(self.substeps - 1, 1)  # of the way to it, each substep
            bend, drift = share * (look.levers - levers), share * (look.free - free)
        first, moved = levers, torch.zeros_like(speed)
        marches, reaches = [_March(speed, moved)], self.reaches.to(speed)
        for number in range(count):
            if bend is not None:
                levers = torch.add(first, bend, alpha=number)
            velocity = self._velocity(levers, speed)
            rising = (velocity * normal).sum(0)
            if number:
                depth = depth - step * rising
            sliding = velocity - rising * normal
            force = self.contact(depth, rising, sliding, normal)
            at = joints + moved[self.limited], speed[self.limited]
            pushes = (levers * force[:, :, None]).sum(0).flatten(0, 1), self.limit(*at)
            push = times(reaches, torch.cat(pushes))
            if self.whole:
                push = torch.cat((force.sum(1), push[self.whole :]))
            gain = free if drift is None else torch.add(free, drift, alpha=number)
            speed = speed + step * (gain + (inverse * push).sum(1))
            moved = self._composed(moved, step * speed)
            marches.append(_March(speed, moved))
        return marches

    def _velocity(self, levers: Tensor, speed: Tensor) -> Tensor:
        """Of the contact points, ``(3, P, N)``, m/s."""
        rates = speed[self.rates].unflatten(0, levers.shape[1:3])
        velocity = (levers * rates).sum(2)
        return velocity + speed[:3, None] if self.whole else velocity

    def _composed(self, moved: Tensor, further: Tensor) -> Tensor:
        """The tangent of two motions, one after the other, to second order."""
        total = moved + further
        if not self.whole:
            return total
        turns = slice(self.whole, 2 * self.whole)
        twist = 0.5 * cross(moved[turns], further[turns])
        return torch.cat((total[: self.whole], total[turns] + twist, total[6:]))

    def _turned(self, rates: Tensor, rotation: Tensor) -> Tensor:
        """``rates (nv, N)`` with the base's velocity in other axes."""
        if not self.whole:
            return rates
        return torch.cat((_rotated(rates[:3], rotation), rates[3:]))


def _rotated(vectors: Tensor, rotation: Tensor) -> Tensor:
    """``rotation (N, 3, 3)`` applied to ``vectors (3, *size, N)``."""
    rotation = rotation.permute(1, 2, 0).to(vectors)
    rotation = rotation.reshape(3, 3, *[1] * (vectors.ndim - 2), -1)
    return (rotation * vectors).sum(1)
