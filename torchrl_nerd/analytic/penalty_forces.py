"""Spring-damper (penalty) contact and joint-limit forces on a batch of robots.

All tensors have the batch last. A contact that slides is the point of MuJoCo's elliptic
friction cone that is nearest to the force of spring and dampers without a cone; its normal
force is a little larger than theirs.
Source: https://mujoco.readthedocs.io/en/stable/computation/#constraint-model
"""

import mujoco
import numpy as np
import torch
from torch import Tensor, nn

from torchrl_nerd.geometry.base import JointAxes, keep_constants
from torchrl_nerd.scenes.penalty_law import (
    PenaltyLaw,
    friction_force,
    limit_forces,
    limit_stiffness,
    normal_force,
)
from torchrl_nerd.scenes.scene import Scene

MIN_SLIP = 1e-6  # m/s: keeps the direction of slip defined at rest


class PenaltyContactForce(nn.Module):
    """Forces of the ground on a robot's contact points.

    Args:
        scene: a robot whose contacts follow the penalty law, with elliptic cones.

    Raises:
        ValueError: contacts of another law or cone.
    """

    law: Tensor

    def __init__(self, scene: Scene) -> None:
        super().__init__()
        model, points = scene.model, scene.contacts
        if model.opt.cone != mujoco.mjtCone.mjCONE_ELLIPTIC:
            raise ValueError(
                "expected elliptic friction cones, got pyramidal ones in scene "
                f"'{scene.name}'"
            )
        law = PenaltyLaw.of_bodies(model, points.bodies)
        # share of the tangential force beyond the cone that becomes normal force
        share = law.friction / model.opt.impratio
        scale = 1.0 / (1.0 + law.friction * share)
        dampers, merged = (law.damping, law.slip), points.merged.sum(1)
        numbers = law.stiffness, *dampers, law.friction, share, scale, merged
        keep_constants(self, law=np.stack(numbers)[..., None])

    def forward(
        self, depth: Tensor, speed: Tensor, slip: Tensor, normal: Tensor
    ) -> Tensor:
        """Forces ``(3, P, N)``, N, on points in the ground, else zero.

        Args:
            depth: in the ground, ``(P, N)``, m.
            speed: along the normal, ``(P, N)``, m/s.
            slip: velocity across the normal, ``(3, P, N)``, m/s.
            normal: of the ground, ``(3, P, N)``.
        """
        stiffness, damping, slip_damping, friction, share, scale, merged = self.law.to(
            depth
        )
        slip_speed = (slip.square().sum(0) + MIN_SLIP**2).sqrt()
        spring, stick_force = (
            stiffness * depth - damping * speed,
            slip_damping * slip_speed,
        )
        on_cone = (scale * (spring + share * stick_force)).clamp_min(0.0)
        on_cone = torch.where(depth > 0.0, on_cone, 0.0)
        pressed = normal_force(stiffness, damping, depth, speed)
        is_sliding = stick_force > friction * spring
        pressed = merged * torch.where(is_sliding, on_cone, pressed)
        drag = friction_force(merged * slip_damping, friction, pressed, slip_speed)
        return pressed * normal - (drag / slip_speed) * slip


class PenaltyLimitForce(nn.Module):
    """Torques of the limits on a robot's joints.

    | attribute | meaning |
    |---|---|
    | ``joints`` | which joints of ``axes`` have limits |

    Args:
        model: compiled.
        axes: its joints.

    Raises:
        ValueError: limits that are no springs and dampers.
    """

    law: Tensor

    def __init__(self, model: mujoco.MjModel, axes: JointAxes) -> None:
        super().__init__()
        is_limited = [bool(model.jnt_limited[joint]) for joint in axes.joints]
        self.joints = np.flatnonzero(is_limited).tolist()
        ids = [axes.joints[index] for index in self.joints]
        low, high = model.jnt_range[ids].T
        springs = limit_stiffness(model, ids) if ids else (low, low)
        keep_constants(self, law=np.stack((*springs, low, high))[..., None])

    def forward(self, position: Tensor, velocity: Tensor) -> Tensor:
        """Torques ``(L, N)``, N m or N, of the joints that have limits.

        Args:
            position: of those joints, ``(L, N)``, rad or m.
            velocity: likewise, rad/s or m/s.
        """
        stiffness, damping, low, high = self.law.to(position)
        law = stiffness, damping, low, high
        below, above = limit_forces(*law, position, velocity)
        return below.clamp_min(0.0) + above.clamp_max(0.0)
