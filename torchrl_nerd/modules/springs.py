"""What springs and dampers push with, at contacts and at joints' limits, in torch.

The law that MuJoCo's soft constraints become at small impedance, see `scenes.penalty_law`.
Friction is its elliptic cone: a contact that slides is the point of the cone that is
nearest to what spring and dampers would push without one, which is a little more normal
force than they would.
Source: https://mujoco.readthedocs.io/en/stable/computation/#constraint-model
"""

import mujoco
import numpy as np
import torch
from torch import Tensor, nn

from torchrl_nerd.geometry.constants import keep_constants
from torchrl_nerd.geometry.joint_axes import JointAxes
from torchrl_nerd.scenes.penalty_law import PenaltyLaw, limit_springs
from torchrl_nerd.scenes.scene import Scene

SLOWEST = 1e-6  # m/s: keeps the direction of slip defined at rest


class ContactSprings(nn.Module):
    """Forces of the ground on a robot's contact points; all tensors have rows last.

    Args:
        scene: a robot whose contacts follow the penalty law, with elliptic cones.

    Raises:
        ValueError: contacts of another kind.
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
        # of the force that slip asks for: how much of it turns into normal force
        share = law.friction / model.opt.impratio
        less = 1.0 / (1.0 + law.friction * share)
        dampers, merged = (law.damping, law.slip), points.merged.sum(1)
        numbers = law.stiffness, *dampers, law.friction, share, less, merged
        keep_constants(self, law=np.stack(numbers)[..., None])

    def forward(
        self, depth: Tensor, speed: Tensor, sliding: Tensor, normal: Tensor
    ) -> Tensor:
        """Forces ``(3, P, N)``, N, on points that are in the ground, else zero.

        Args:
            depth: in the ground, ``(P, N)``, m.
            speed: along the normal, ``(P, N)``, m/s.
            sliding: across it, ``(3, P, N)``, m/s.
            normal: of the ground, ``(3, P, N)``.
        """
        stiffness, damping, slip, friction, share, less, merged = self.law.to(depth)
        slipping = (sliding.square().sum(0) + SLOWEST**2).sqrt()
        push, pull = stiffness * depth - damping * speed, slip * slipping
        nearest = (less * (push + share * pull)).clamp_min(0.0)
        push = torch.where(pull > friction * push, nearest, push)
        push = torch.where(depth > 0.0, merged * push, 0.0)
        drag = torch.minimum(merged * slip, friction * push / slipping)
        return push * normal - drag * sliding


class LimitSprings(nn.Module):
    """Torques of the limits on a robot's joints; all tensors have rows last.

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
        ids = [axes.joints[place] for place in self.joints]
        low, high = model.jnt_range[ids].T
        springs = limit_springs(model, ids) if ids else (low, low)
        keep_constants(self, law=np.stack((*springs, low, high))[..., None])

    def forward(self, position: Tensor, speed: Tensor) -> Tensor:
        """Torques ``(L, N)``, N m or N, of the joints that have limits.

        Args:
            position: of those joints, ``(L, N)``, rad or m.
            speed: likewise, rad/s or m/s.
        """
        stiffness, damping, low, high = self.law.to(position)
        inward = stiffness * (low - position) - damping * speed
        outward = stiffness * (position - high) + damping * speed
        up = torch.where(position < low, inward.clamp_min(0.0), 0.0)
        return up - torch.where(position > high, outward.clamp_min(0.0), 0.0)
