"""Penetration of contact points over the coming step, predicted without contact forces.

A damper acts from the substep on at which its point is first in the ground. Fast points
move 0.1 m per substep, and a fraction of a millimetre decides in which substep contact
begins, so the prediction has to be accurate.
"""

import numpy as np
import torch
from torch import Tensor, nn

from torchrl_nerd.geometry.base import BasePose, keep_constants, over_ground
from torchrl_nerd.geometry.kinematics import PointKinematics
from torchrl_nerd.geometry.manifold import integrate_pos
from torchrl_nerd.scenes.scene import Scene
from torchrl_nerd.scenes.terrain import TerrainDistance

MAX_TIMES = 5  # within a step


class PredictedPenetration(nn.Module):
    """Predicted penetration of every contact point at K times of the step.

    The K = min(substeps, 5) times are spaced evenly from the step's start on: with few
    substeps they are those at which MuJoCo evaluates collision.

    Args:
        scene: the robot and its ground.
        ground: distances to that ground.
        pose: of its base.
    """

    radii: Tensor
    parabola: Tensor
    cubic: Tensor

    def __init__(self, scene: Scene, ground: TerrainDistance, pose: BasePose) -> None:
        super().__init__()
        points = scene.contacts
        self.base, self.layout = scene.base, scene.layout
        self.period = scene.control_step
        self.substeps = scene.substeps // scene.reference_ratio
        self.ground, self.pose = ground, pose
        self.kinematics = PointKinematics(
            scene.model, scene.base, points.bodies, points.positions
        )
        times = num_times(scene)
        one = np.arange(times) / times
        two, three = one**2, one**3
        blend = 3.0 * two - 2.0 * three
        keep_constants(
            self,
            radii=points.radii,
            parabola=np.stack((1.0 - two, one - two, two)),
            cubic=np.stack((1.0 - blend, one - 2.0 * two + three, blend, three - two)),
        )

    def forward(
        self,
        qpos: Tensor,
        qvel: Tensor,
        terrain: Tensor | None,
        gain: Tensor | None,
        depth: Tensor,
        speed: Tensor,
    ) -> Tensor:
        """Penetrations ``(*batch, P, K)``, m, at least zero.

        At constant velocity the parabola through the depth and its rate now and the depth
        after the step. Along unconstrained motion the cubic through depths and rates at
        both ends, accurate to 0.02 mm in the double pendulum's impacts.

        Args:
            qpos: ``(*batch, nq)``.
            qvel: ``(*batch, nv)``.
            terrain: ``(*batch, terrain.size)``; None for the scene's own ground.
            gain: velocity change of unconstrained motion over the step, ``(*batch, nv)``;
                None: at constant velocity.
            depth: of every point now, ``(*batch, P)``, m.
            speed: of every point along its normal now, ``(*batch, P)``, m/s.
        """
        if gain is None:
            later = integrate_pos(self.layout, qpos, self.period * qvel)
            points, _ = self.kinematics(later, qvel.new_empty(0, qvel.shape[-1]))
            distance, _ = self.ground(points, terrain, *self.pose(later))
            ends = depth, -self.period * speed, self.radii - distance
            return (torch.stack(ends, -1) @ self.parabola).clamp_min(0.0)
        first = qvel + 0.5 / self.substeps * gain  # semi-implicit Euler: velocity first
        mean, last = first + 0.5 * gain, first + gain
        later = integrate_pos(self.layout, qpos, self.period * mean)
        states, rates = torch.stack((qpos, later)), torch.stack((first, last))
        points, velocity = self.kinematics(states, rates)
        pose = self.pose(states)
        if terrain is not None:
            terrain = terrain.expand(2, *terrain.shape)
        distance, normal = self.ground(points, terrain, *pose)
        velocity = over_ground(self.base, rates, points, velocity, pose[1])
        rate = -self.period * (velocity * normal).sum(-1)
        ends = torch.stack((self.radii - distance, rate), -1)  # (2, *batch, P, 2)
        return (torch.cat((ends[0], ends[1]), -1) @ self.cubic).clamp_min(0.0)


def num_times(scene: Scene) -> int:
    """K: number of predicted times per step."""
    return min(scene.substeps // scene.reference_ratio, MAX_TIMES)
