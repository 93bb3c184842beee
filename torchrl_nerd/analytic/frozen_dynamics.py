"""The dynamics of a robot at one time, held while substeps integrate contact forces."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from torchrl_nerd.geometry.base import BasePose, JointAxes, keep_constants, keep_indices
from torchrl_nerd.geometry.kinematics import PointKinematics
from torchrl_nerd.geometry.motion import cross
from torchrl_nerd.geometry.rigid_body import RigidBodyDynamics, rows_last
from torchrl_nerd.geometry.spd import BranchSparsity, spd_inverse
from torchrl_nerd.scenes.contact_points import shape_points
from torchrl_nerd.scenes.scene import Scene
from torchrl_nerd.scenes.terrain import TerrainDistance


class FrozenDynamics(NamedTuple):
    """Dynamics at one state, in the base frame there; batch last."""

    jacobian: Tensor  # (3, P, C, N): of each contact point, by its C own dofs, m or 1
    normal: Tensor  # (3, P, N)
    depth: Tensor  # (P, N), m
    qacc_smooth: Tensor  # (nv, N): acceleration without contacts and limits
    mass_matrix_inv: Tensor  # (nv, nv, N)
    rotation: Tensor  # (N, 3, 3), of the base, world


class DynamicsEvaluation(nn.Module):
    """Evaluates the `FrozenDynamics` of a robot over its ground.

    Joint damping is implicit over ``damping_period`` s. A scene without ground raises
    ValueError.
    """

    joints: Tensor  # (P C',): joints that move each point, flat
    jacobian_dofs: Tensor  # of the Jacobian's columns: C of each of the P points, flat
    joint_weights: Tensor  # (P, C', 1)
    radii: Tensor  # (P, 1), m
    is_slide: Tensor  # (P, C', 1)

    def __init__(self, scene: Scene, axes: JointAxes, damping_period: float) -> None:
        super().__init__()
        model, points = scene.model, scene.contacts
        if scene.terrain is None:
            raise ValueError(f"expected a scene with a ground, got '{scene.name}'")
        self.damping_period = damping_period
        self.num_points, self.num_axes = len(points), len(axes.joints)
        self.branches = BranchSparsity.of(model)
        self.rigid_body = RigidBodyDynamics(model, scene.base, axes, scene.actuated)
        bodies = points.bodies + self.rigid_body.bodies
        places = np.concatenate((points.positions, self.rigid_body.positions))
        self.kinematics = PointKinematics(model, scene.base, bodies, places)
        self.pose = BasePose(model, scene.base)
        self.ground = TerrainDistance(scene.terrain, float(points.margins.max()))
        # linear ones, which move every point; the base's angular ones come next
        self.num_base_dofs = 3 * scene.base.is_floating
        # points of several bodies in one place act together, each moved by its own joints
        every, *_ = shape_points(model, scene.max_contact_points)
        weights = points.merged @ axes.ancestry[:, every].T
        weights /= points.merged.sum(1, keepdims=True)  # (P, J)
        longest = int((weights > 0.0).sum(1).max(initial=0))
        # a point's own joints first, then others of weight zero, to fill the row
        joints = np.argsort(-weights, 1, kind="stable")[:, :longest]
        self.shape = joints.shape
        angular = range(self.num_base_dofs, 2 * self.num_base_dofs)
        dofs = [[*angular, *(2 * self.num_base_dofs + row)] for row in joints]
        dofs = np.concatenate(dofs)
        keep_indices(self, joints=joints.flatten(), jacobian_dofs=dofs)
        keep_constants(
            self,
            joint_weights=np.take_along_axis(weights, joints, 1)[..., None],
            radii=points.radii[:, None],
            is_slide=axes.is_slide[joints][..., None],
        )

    def forward(
        self,
        qpos: Tensor,
        qvel: Tensor,
        joint_torque: Tensor | None,
        terrain: Tensor | None,
        dtype: torch.dtype,
    ) -> FrozenDynamics:
        """The dynamics at a state, ``qpos (N, nq)``; see `AnalyticStep.forward`.

        ``dtype``: of the result but for the base's rotation, which is float64.
        """
        found, _ = self.kinematics(qpos, qvel)
        sizes = self.num_points, len(self.rigid_body.bodies)
        points, places = found.split(sizes, -2)
        position, rotation = self.pose(qpos)
        distance, normal = self.ground(points, terrain, position, rotation)
        given = qpos, qvel, joint_torque, rotation, places, self.damping_period
        motion = self.rigid_body.mass_matrix_and_force(*given)
        inverse, qacc = spd_inverse(*motion, self.branches)
        depth, normal = self.radii - distance.mT, rows_last(normal, 2)
        # a sphere's contact is halfway between its surface and the ground, as MuJoCo's
        inwards = self.radii - 0.5 * depth.clamp_min(0.0)  # (P, N), m
        points = rows_last(points, 2) - inwards * normal
        axes = places[..., : 2 * self.num_axes, :]
        jacobian = self._jacobian(points, rows_last(axes, 2))
        parts = jacobian, normal, depth, qacc, inverse
        frozen = (x.to(dtype).contiguous() for x in parts)
        return FrozenDynamics(*frozen, rotation=rotation)

    def point_velocity(self, jacobian: Tensor, qvel: Tensor) -> Tensor:
        """Velocities ``(3, P, N)`` of the contact points, m/s, at ``qvel (nv, N)``."""
        own = qvel[self.jacobian_dofs].unflatten(0, jacobian.shape[1:3])
        velocity = (jacobian * own).sum(2)
        return velocity + qvel[:3, None] if self.num_base_dofs else velocity

    def _jacobian(self, points: Tensor, places: Tensor) -> Tensor:
        """Contact Jacobian ``(3, P, C, N)``: velocity of each point by each of its dofs."""
        anchor, tip = places.chunk(2, 1)
        axis, anchor = (  # (3, P, C, N)
            x[:, self.joints].unflatten(1, self.shape) for x in (tip - anchor, anchor)
        )
        turning = cross(axis, points[:, :, None] - anchor)
        jacobian = self.joint_weights * torch.where(self.is_slide > 0.0, axis, turning)
        if not self.num_base_dofs:
            return jacobian
        one = torch.eye(3, dtype=points.dtype, device=points.device)
        base = cross(one[:, None, :, None], points[:, :, None])
        return torch.cat((base, jacobian), 2)
