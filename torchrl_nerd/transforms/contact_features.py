"""Contact features of the ground, in the robot's own frame.

NeRD section 3.2 feeds closest point p1, normal n and distance d of every contact point,
zeroed beyond the margin xi. p1 follows from kinematics, n and d, so it is left out. Where
the ground is one plane that all envs share, and it is level (gravity is normal to it)
or a fixed base cannot turn against it, n follows from gravity and pose, and is left out
too. Of several surfaces each point sees the nearest, so that a model fits any number.
Added are velocities and predictions, see `predicted_contact`; all fades to zero at the
margin.
"""

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_nerd.configs import NO_PREDICTIONS, FeatureConfig
from torchrl_nerd.geometry.base import BasePose, JointAxes, keep_constants, over_ground
from torchrl_nerd.geometry.kinematics import PointKinematics
from torchrl_nerd.geometry.manifold import integrate_pos
from torchrl_nerd.geometry.rigid_body import RigidBodyDynamics
from torchrl_nerd.keys import (
    CONTACT_DEPTH,
    CONTACT_DISTANCE,
    CONTACT_FORCE,
    CONTACT_NORMAL,
    CONTACT_VELOCITY,
    JOINT_TORQUE,
    QPOS,
    QVEL,
    TERRAIN,
)
from torchrl_nerd.scenes.scene import Scene
from torchrl_nerd.scenes.support import unit_gravity
from torchrl_nerd.scenes.terrain import TerrainDistance
from torchrl_nerd.transforms.base import FeatureTransform
from torchrl_nerd.transforms.predicted_contact import (
    AlongUnconstrainedMotion,
    PredictedForce,
    depth_at_constant_velocity,
    parabola,
    times_of,
)

FADE = 0.25  # share of the way from margin to touching over which velocities fade in


class ContactFeatures(FeatureTransform):
    """Distance, velocity and, where it varies, normal of every contact point, in B_t.

    With P contact points, gate g(d) = 0 at d >= xi and 1 well inside:

    | out key | what | width |
    |---|---|---|
    | ``contact_distance`` | min(d - xi, 0), m | P |
    | ``contact_velocity`` | g * (normal speed, tangential velocity), m/s | 4 P |
    | ``contact_depth`` | g * predicted penetration at K times of the step, at constant
      velocity or, with ``unconstrained_motion``, along that motion, m | K P |
    | ``contact_force`` | with ``predicted_force``: mean generalised force of the penalty
      contacts over the step, N and N m, see `PredictedForce` | nv |
    | ``contact_normal`` | g * n; only where pose and gravity do not tell it | 3 P |

    The K = min(substeps, 5) times are those of `times_of`. A scene without
    contact gives no keys at all. ``features`` adds predictions; none by default.
    """

    why_no_inverse = "distances do not determine a pose"
    radii: Tensor
    margins: Tensor
    parabola: Tensor

    def __init__(self, scene: Scene, features: FeatureConfig = NO_PREDICTIONS) -> None:
        count, terrain = len(scene.contacts), scene.terrain
        sizes: dict[NestedKey, int] = {}
        in_keys: list[NestedKey] = []
        if terrain is not None:
            in_keys = [QPOS, QVEL]
            sizes = {CONTACT_DISTANCE: count, CONTACT_VELOCITY: 4 * count}
            sizes[CONTACT_DEPTH] = len(times_of(scene)) * count
            if terrain.is_per_env:
                in_keys.append(TERRAIN)
            if features.predicted_force:
                sizes[CONTACT_FORCE] = scene.layout.nv
            plane, down = terrain.fixed_plane, unit_gravity(scene.model)
            is_level = plane is not None and abs(float(plane[:3] @ down)) > 1.0 - 1e-12
            if plane is None or (scene.base.is_floating and not is_level):
                sizes[CONTACT_NORMAL] = 3 * count
        super().__init__(scene, in_keys, sizes)
        self.terrain, self.base = terrain, scene.base
        self.step_size, self.num_torques = scene.control_step, len(scene.actuated)
        if terrain is None:
            return
        points = scene.contacts
        # one pass of kinematics: contact points, then joint axes, then inertia's points
        bodies, positions = points.bodies, points.positions
        self.force, self.rigid_body, self.num_axis_points = None, None, 0
        if features.predicted_force or features.unconstrained_motion:
            axes = further = JointAxes.of(scene.model, scene.base)
            self.num_axis_points = len(axes.bodies)
            if features.predicted_force:
                self.force = PredictedForce(scene, axes)
            if features.unconstrained_motion:
                robot = scene.model, scene.base, axes, scene.actuated
                self.rigid_body = further = RigidBodyDynamics(*robot)
            bodies = bodies + further.bodies
            positions = np.concatenate((positions, further.positions))
        self.kinematics = PointKinematics(scene.model, scene.base, bodies, positions)
        self.count = count
        self.ground = TerrainDistance(terrain, float(points.margins.max()))
        self.pose = BasePose(scene.model, scene.base)
        self.layout = scene.layout
        if self.rigid_body is not None:
            given = scene, self.ground, self.pose
            self.along_unconstrained_motion = AlongUnconstrainedMotion(*given)
        own = parabola(times_of(scene))
        keep_constants(self, radii=points.radii, margins=points.margins, parabola=own)

    def contact_features(
        self,
        qpos: Tensor,
        qvel: Tensor,
        terrain: Tensor | None = None,
        drive: Tensor | None = None,
    ) -> list[Tensor]:
        """The outputs in the order of ``out_keys``, in the dtype of the inputs.

        Of ``qpos (*batch, nq)``, ``qvel (*batch, nv)``, the ``terrain (*batch, n)``, None
        for the scene's own ground, and the ``drive`` of the coming step: joint torques
        ``(*batch, num_actuated)`` and servos' controls after them; None if unknown.
        """
        if self.terrain is None:
            return []
        states = qpos[None]  # (1, *batch, nq), or (2, *batch, nq) with the step's end
        if self.rigid_body is None:
            later = integrate_pos(self.layout, qpos, self.step_size * qvel)
            states = torch.stack((qpos, later))
        # where the robot is now alone, points need a velocity
        found, velocity = self.kinematics(states, qvel[None])
        sizes = (self.count, found.shape[-2] - self.count)
        points, places = found.split(sizes, -2)  # (1 or 2, *batch, P, 3), ...
        ground = (
            None if terrain is None else terrain.expand(len(states), *terrain.shape)
        )
        pose = self.pose(states)
        distances, normals = self.ground(points, ground, *pose)
        now, places, distance, normal = points[0], places[0], distances[0], normals[0]
        rotation, velocity = pose[1][0], velocity[0, ..., : self.count, :]
        velocity = over_ground(self.base, qvel, now, velocity, rotation)
        beyond = distance - self.margins
        gate = (beyond / (FADE * (self.radii - self.margins))).clamp(0.0, 1.0)
        gate = gate[..., None]  # (*batch, P, 1)
        speed = (velocity * normal).sum(-1)
        sliding = velocity - speed[..., None] * normal
        if self.rigid_body is None:
            depths = self.radii - distances  # (2, *batch, P)
            motion = depths[0], -self.step_size * speed, depths[1]
            penetration = depth_at_constant_velocity(self.parabola, *motion)
        else:
            torque = None if drive is None else drive[..., : self.num_torques]
            given = qpos, qvel, torque, rotation, places, self.step_size
            change = self.step_size * self.rigid_body(*given)
            motion = qpos, qvel, terrain, change
            penetration = self.along_unconstrained_motion(*motion)
        depth = gate * penetration  # (*batch, P, K)
        moving = gate * torch.cat((speed[..., None], sliding), -1)  # (*batch, P, 4)
        features = [beyond.clamp_max(0.0), moving.flatten(-2), depth.flatten(-2)]
        if self.force is not None:
            contact = now, normal, depth, speed[..., None], sliding
            axes = places[..., : self.num_axis_points, :]
            features.append(self.force(*contact, axes))
        if CONTACT_NORMAL in self.sizes:
            features.append((gate * normal).flatten(-2))
        return features

    def _features(self, tensordict: TensorDictBase) -> dict:
        terrain = tensordict[TERRAIN] if TERRAIN in self.in_keys else None
        torque = tensordict.get(JOINT_TORQUE, None)
        state = tensordict[QPOS], tensordict[QVEL]
        values = self.contact_features(*state, terrain, torque)
        return dict(zip(self.out_keys, values, strict=True))
