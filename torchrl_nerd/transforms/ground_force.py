"""What the ground's springs and dampers push every joint with, foreseen along the step.

The contacts of the paper's engine are an explicit law of depth and speed (see
`scenes.penalty_law`). What it says on the way that every point would take if the velocities
stayed is no more than a guess at the step's forces, since stiff springs change velocities
within the step; but it puts many points, their gaps and their levers into one number per
degree of freedom, which a network would have to work out by itself.
"""

import numpy as np
import torch
from torch import Tensor, nn

from torchrl_nerd.geometry.constants import keep_constants
from torchrl_nerd.geometry.joint_axes import JointAxes
from torchrl_nerd.scenes.penalty_law import PenaltyLaw
from torchrl_nerd.scenes.scene import Scene

SLOWEST = 1e-9  # m/s: keeps the direction of slip defined at rest


class GroundForce(nn.Module):
    """Generalised force ``J^T f`` of the contact points' springs, in B_t.

    Args:
        scene: a robot whose contacts follow the penalty law.
        axes: its joints.

    Raises:
        ValueError: contacts of another kind.
    """

    law: Tensor
    carries: Tensor
    is_slide: Tensor

    def __init__(self, scene: Scene, axes: JointAxes) -> None:
        super().__init__()
        model, self.is_floating = scene.model, scene.base.is_floating
        law = PenaltyLaw.of_bodies(model, scene.contacts.bodies)
        merged = scene.contacts.merged.sum(1)
        numbers = law.stiffness, law.damping, law.slip, law.friction, merged
        keep_constants(
            self,
            law=np.stack(numbers),
            carries=axes.carries(scene.contacts.bodies),
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

        Args:
            points: ``(*batch, P, 3)``, m, as all that follows in and relative to B_t.
            normal: of the ground at each, ``(*batch, P, 3)``.
            depth: at K times of the step, ``(*batch, P, K)``, m, zero beside the ground.
            speed: along the normal, ``(*batch, P, 1)``, m/s.
            sliding: across it, ``(*batch, P, 3)``, m/s.
            places: of the axes' anchors and tips, ``(*batch, 2 J, 3)``, m.
        """
        stiffness, damping, slip, friction, merged = self.law
        touches = depth > 0.0
        push = stiffness[:, None] * depth - damping[:, None] * speed
        push = torch.where(touches, push.clamp_min(0.0), 0.0).mean(-1)
        slipping = torch.linalg.vector_norm(sliding, dim=-1)
        share = touches.to(push.dtype).mean(-1)
        drag = torch.minimum(slip * slipping * share, friction * push)
        drag = drag / (slipping + SLOWEST)
        force = push[..., None] * normal - drag[..., None] * sliding
        force = merged[:, None] * force  # points in one place push one by one
        moment = torch.linalg.cross(points, force)
        anchor, tip = places.chunk(2, -2)
        force_on, moment_on = self.carries @ force, self.carries @ moment
        turning = moment_on - torch.linalg.cross(anchor, force_on)
        along = torch.where(self.is_slide[:, None] > 0.0, force_on, turning)
        parts = [((tip - anchor) * along).sum(-1)]
        if self.is_floating:
            parts = [force.sum(-2), moment.sum(-2), *parts]
        return torch.cat(parts, -1)
