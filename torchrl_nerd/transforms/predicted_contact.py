"""Predicted contact over the coming step: penetration and force, without a solver.

Features of contact that a network learns slowly from distance and speed: a damper acts
from the substep on at which its point is first in the ground. Fast points move 0.1 m per
substep, and a fraction of a millimetre decides in which substep contact begins.
"""

import numpy as np
import torch
from torch import Tensor, nn

from torchrl_nerd.geometry.base import BasePose, JointAxes, keep_constants, over_ground
from torchrl_nerd.geometry.kinematics import PointKinematics
from torchrl_nerd.geometry.manifold import integrate_pos
from torchrl_nerd.scenes import penalty_law
from torchrl_nerd.scenes.scene import Scene
from torchrl_nerd.scenes.terrain import TerrainDistance

MAX_TIMES = 5  # within a step
MIN_SLIP = 1e-9  # m/s: keeps the direction of slip defined at rest


class AlongUnconstrainedMotion(nn.Module):
    """Predicted penetration at the same K times, if no contact changes the motion.

    The cubic through depths and rates at both ends of the step, accurate to 0.02 mm in
    the double pendulum's impacts.
    """

    radii: Tensor
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
        one = times_of(scene)
        two, three = one**2, one**3
        blend = 3.0 * two - 2.0 * three
        # polynomials at the K times, by their values and slopes at the ends
        cubic = np.stack((1.0 - blend, one - 2.0 * two + three, blend, three - two))
        keep_constants(self, radii=points.radii, cubic=cubic)

    def forward(
        self, qpos: Tensor, qvel: Tensor, terrain: Tensor | None, change: Tensor
    ) -> Tensor:
        """Penetrations ``(*batch, P, K)``, m, at least zero.

        ``change (*batch, nv)`` is that of the velocity over the step.
        """
        # semi-implicit Euler: velocity first
        first = qvel + 0.5 / self.substeps * change
        mean, last = first + 0.5 * change, first + change
        later = integrate_pos(self.layout, qpos, self.period * mean)
        # both ends of the step at once: (2, *batch, nq) and (2, *batch, nv)
        states, rates = torch.stack((qpos, later)), torch.stack((first, last))
        points, velocity = self.kinematics(states, rates)
        pose = self.pose(states)
        if terrain is not None:
            terrain = terrain.expand(2, *terrain.shape)
        distance, normal = self.ground(points, terrain, *pose)
        velocity = over_ground(self.base, rates, points, velocity, pose[1])
        rate = -self.period * (velocity * normal).sum(-1)
        ends = torch.stack((self.radii - distance, rate), -1)  # (2, *batch, P, 2)
        # (*batch, P, 4) @ (4, K)
        return (torch.cat((ends[0], ends[1]), -1) @ self.cubic).clamp_min(0.0)


def times_of(scene: Scene) -> np.ndarray:
    """The predicted times as shares of the step, ``(K,)``.

    The K = min(substeps, 5) times are spaced evenly from the step's start on: with few
    substeps they are those at which MuJoCo evaluates collision.
    """
    count = min(scene.substeps // scene.reference_ratio, MAX_TIMES)
    return np.arange(count) / count


def depth_at_constant_velocity(
    parabola: Tensor, depth: Tensor, change: Tensor, later: Tensor
) -> Tensor:
    """Penetrations ``(*batch, P, K)``, m, at least zero, if every point keeps its velocity.

    The parabola through the ``depth (*batch, P)``, m, its ``change`` over the step at
    today's speed and what it is ``later``, after the step; at the K times of `times_of`.
    """
    # (*batch, P, 3) @ (3, K)
    return (torch.stack((depth, change, later), -1) @ parabola).clamp_min(0.0)


def parabola(times: np.ndarray) -> np.ndarray:
    """What a parabola at ``times (K,)`` is of its start, its first slope and its end.

    ``(3, K)``: shares of the three, for a parabola over the times from 0 to 1.
    """
    square = times**2
    return np.stack((1.0 - square, times - square, square))


class PredictedForce(nn.Module):
    """Predicted generalised force ``J^T f`` of all contact points, in B_t.

    The penalty law (see `scenes.penalty_law`) on the predicted motion of every point.
    Stiff contacts change velocities within the step, so this is an estimate only; but it
    condenses many points, depths and Jacobians into one number per degree of freedom.

    Raises:
        ValueError: contacts of another kind.
    """

    law: Tensor
    ancestry: Tensor
    is_slide: Tensor

    def __init__(self, scene: Scene, axes: JointAxes) -> None:
        super().__init__()
        model, self.is_floating = scene.model, scene.base.is_floating
        law = penalty_law.PenaltyLaw.of_bodies(model, scene.contacts.bodies)
        merged = scene.contacts.merged.sum(1)
        numbers = law.stiffness, law.damping, law.slip, law.friction, merged
        keep_constants(
            self,
            law=np.stack(numbers),  # (5, P)
            ancestry=axes.ancestry[:, scene.contacts.bodies],  # (J, P)
            is_slide=axes.is_slide,
        )

    def forward(
        self,
        points: Tensor,
        normal: Tensor,
        depth: Tensor,
        speed: Tensor,
        sliding: Tensor,
        places: Tensor,
    ) -> Tensor:
        """``(*batch, nv)``, N and N m; the base's six first, force before moment.

        All is given in and relative to B_t: ``points (*batch, P, 3)``, m; the ground's
        ``normal`` at each; ``depth (*batch, P, K)`` at K times of the step, m, zero beside
        the ground; ``speed (*batch, P, 1)`` along the normal and ``sliding (*batch, P, 3)``
        across it, m/s; ``places (*batch, 2 J, 3)`` of the axes' anchors and tips, m.
        """
        stiffness, damping, slip, friction, merged = self.law
        spring, damper = stiffness[:, None], damping[:, None]
        # mean over the K times: (*batch, P)
        normal_force = penalty_law.normal_force(spring, damper, depth, speed).mean(-1)
        slipping = torch.linalg.vector_norm(sliding, dim=-1)
        touching = (depth > 0.0).to(normal_force.dtype).mean(-1)  # share of the step
        friction_force = penalty_law.friction_force(
            slip * touching, friction, normal_force, slipping
        )
        per_slip = friction_force / (slipping + MIN_SLIP)
        force = normal_force[..., None] * normal - per_slip[..., None] * sliding
        force = merged[:, None] * force  # coinciding points act one by one
        moment = torch.linalg.cross(points, force)
        anchor, tip = places.chunk(2, -2)  # (*batch, J, 3) each
        # one product of matrices, not one for every robot: (2, *batch, 3, P) @ (P, J)
        both = torch.stack((force, moment)).mT @ self.ancestry.mT
        force_on, moment_on = both.mT  # (*batch, J, 3) each
        turning = moment_on - torch.linalg.cross(anchor, force_on)
        along = torch.where(self.is_slide[:, None] > 0.0, force_on, turning)
        parts = [((tip - anchor) * along).sum(-1)]  # (*batch, J)
        if self.is_floating:
            parts = [force.sum(-2), moment.sum(-2), *parts]
        return torch.cat(parts, -1)
