"""What pushes a robot at one time: mass matrix, free motion, points and what moves them."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from torchrl_nerd.geometry.base import BasePose
from torchrl_nerd.geometry.constants import keep_constants
from torchrl_nerd.geometry.elimination import Limbs, inverted
from torchrl_nerd.geometry.free_motion import FreeMotion, rows_last
from torchrl_nerd.geometry.joint_axes import JointAxes
from torchrl_nerd.geometry.kinematics import PointKinematics, cross
from torchrl_nerd.scenes.contact_points import shape_points
from torchrl_nerd.scenes.scene import Scene
from torchrl_nerd.scenes.terrain_distance import TerrainDistance


class Look(NamedTuple):
    """A robot at one time, in its base's axes there; rows last."""

    levers: Tensor  # (3, P, C, N): what each of its C rates moves a point by, m or 1
    normal: Tensor  # (3, P, N)
    depth: Tensor  # (P, N), m
    free: Tensor  # (nv, N): acceleration without springs
    inverse: Tensor  # (nv, nv, N), of the mass matrix
    rotation: Tensor  # (N, 3, 3), of the base


class LookAt(nn.Module):
    """A `Look` at a robot over its ground.

    | attribute | meaning |
    |---|---|
    | ``rates`` | entries of qvel that move a contact point beside a floating base's
      velocity, C of each of the P points |

    Args:
        scene: a robot of hinges and slides, on a free base or a fixed one, over a ground.
        axes: its joints.
        implicit: s, over which the damping of joints acts as it changes; 0: as it is.

    Raises:
        ValueError: a scene without ground.
    """

    joints: Tensor
    rates: Tensor
    has: Tensor
    radii: Tensor
    is_slide: Tensor

    def __init__(self, scene: Scene, axes: JointAxes, implicit: float) -> None:
        super().__init__()
        model, points = scene.model, scene.contacts
        if scene.terrain is None:
            raise ValueError(f"expected a ground to step on, got scene '{scene.name}'")
        self.implicit = implicit
        self.num_points, self.num_axes = len(points), len(axes.joints)
        self.limbs = Limbs.of(model)
        self.motion = FreeMotion(model, scene.base, axes, scene.actuated)
        bodies = points.bodies + axes.bodies + self.motion.bodies
        places = points.positions, axes.positions, self.motion.positions
        places = np.concatenate(places)
        self.kinematics = PointKinematics(model, scene.base, bodies, places)
        self.pose = BasePose(scene.base, scene.fixed_base_pose)
        self.ground = TerrainDistance(scene.terrain, float(points.margins.max()))
        self.whole = 3 * scene.base.is_floating  # rates that turn all there is
        # rims of several bodies in one place push together, each turned by its own joints
        carried = points.merged @ axes.carries(shape_points(model)[0]).T
        carried /= points.merged.sum(1, keepdims=True)  # (P, J)
        longest = int((carried > 0.0).sum(1).max(initial=0))
        # a point's own joints first, then others, which have no lever, to fill the row
        joints = np.argsort(-carried, 1, kind="stable")[:, :longest]
        self.shape = joints.shape
        whole = range(self.whole, 2 * self.whole)
        rates = [[*whole, *(2 * self.whole + row)] for row in joints]
        # as tensors, since compiled code takes long lists for questions of each entry
        for name, numbers in (
            ("joints", joints.flatten()),
            ("rates", np.concatenate(rates)),
        ):
            index = torch.from_numpy(np.array(numbers, dtype=np.int64))
            self.register_buffer(name, index, persistent=False)
        keep_constants(
            self,
            has=np.take_along_axis(carried, joints, 1)[..., None],
            radii=points.radii[:, None],
            is_slide=axes.is_slide[joints][..., None],
        )

    def forward(
        self,
        qpos: Tensor,
        qvel: Tensor,
        joint_torque: Tensor,
        terrain: Tensor | None,
        dtype: torch.dtype,
    ) -> Look:
        """What is there at ``qpos (N, nq)``, ``qvel (N, nv)``; all but the base in dtype.

        Args:
            qpos: ``(N, nq)``.
            qvel: ``(N, nv)``.
            joint_torque: ``(N, num_actuated)``.
            terrain: ``(N, terrain.size)``; None for the scene's own ground.
            dtype: of all but the base's rotation, which is float64.
        """
        found, _ = self.kinematics(qpos, qvel)
        sizes = self.num_points, 2 * self.num_axes
        points, places, corners = found.split(
            (*sizes, found.shape[-2] - sum(sizes)), -2
        )
        position, rotation = self.pose(qpos)
        distance, normal = self.ground(points, terrain, position, rotation)
        matrix, push = self.motion.equation(
            qpos, qvel, joint_torque, rotation, corners, places, self.implicit
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
        return Look(levers, normal, depth, free, inverse, rotation)

    def velocity(self, levers: Tensor, speed: Tensor) -> Tensor:
        """Of the contact points, ``(3, P, N)``, m/s, at rates ``speed (nv, N)``."""
        rates = speed[self.rates].unflatten(0, levers.shape[1:3])
        velocity = (levers * rates).sum(2)
        return velocity + speed[:3, None] if self.whole else velocity

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
