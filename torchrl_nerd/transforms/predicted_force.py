"""Generalised force of the penalty contacts, predicted over the coming step.

The law (see `geometry.penalty`) is evaluated on the predicted motion of every contact
point. Stiff contacts change velocities within the step, so this is an estimate only; but it
condenses many points, their depths and their Jacobians into one number per degree of
freedom, which a network would have to compute by itself.
"""

import numpy as np
import torch
from torch import Tensor, nn

from torchrl_nerd.geometry.base import JointAxes, keep_constants
from torchrl_nerd.scenes.penalty_law import PenaltyLaw, friction_force, normal_force
from torchrl_nerd.scenes.scene import Scene

MIN_SLIP = 1e-9  # m/s: keeps the direction of slip defined at rest


class PredictedForce(nn.Module):
    """Predicted generalised force ``J^T f`` of all contact points, in B_t.

    Args:
        scene: a robot whose contacts follow the penalty law.
        axes: its joints.

    Raises:
        ValueError: contacts of another kind.
    """

    law: Tensor
    ancestry: Tensor
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
            ancestry=axes.ancestry(scene.contacts.bodies),
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
        push = normal_force(stiffness[:, None], damping[:, None], depth, speed).mean(-1)
        slipping = torch.linalg.vector_norm(sliding, dim=-1)
        touching = (depth > 0.0).to(push.dtype).mean(-1)  # share of the step
        drag = friction_force(slip * touching, friction, push, slipping)
        drag = drag / (slipping + MIN_SLIP)
        force = push[..., None] * normal - drag[..., None] * sliding
        force = merged[:, None] * force  # coinciding points act one by one
        moment = torch.linalg.cross(points, force)
        anchor, tip = places.chunk(2, -2)
        force_on, moment_on = self.ancestry @ force, self.ancestry @ moment
        turning = moment_on - torch.linalg.cross(anchor, force_on)
        along = torch.where(self.is_slide[:, None] > 0.0, force_on, turning)
        parts = [((tip - anchor) * along).sum(-1)]
        if self.is_floating:
            parts = [force.sum(-2), moment.sum(-2), *parts]
        return torch.cat(parts, -1)
