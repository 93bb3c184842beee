"""What the ground's springs and dampers push every joint with, foreseen along the step.

The contacts of the paper's engine are an explicit law of depth and speed (see
`scenes.penalty`). What it says on the way that every point would take if the velocities
stayed is no more than a guess at the step's forces, since stiff springs change velocities
within the step; but it puts many points, their gaps and their levers into one number per
degree of freedom, which a network would have to work out by itself.
"""

import mujoco
import numpy as np
import torch
from torch import Tensor, nn

from torchrl_nerd.geometry.kinematics import HINGE, SLIDE
from torchrl_nerd.scenes.penalty import PenaltyLaw
from torchrl_nerd.scenes.scene import Scene

SLOWEST = 1e-9  # m/s: keeps the direction of slip defined at rest


class GroundForce(nn.Module):
    """Generalised force ``J^T f`` of the contact points' springs, in B_t.

    The anchor and the tip of the axis of every joint are points on its body, for
    `PointKinematics` to find beside the contact points.

    | attribute | meaning |
    |---|---|
    | ``bodies`` | of those points: all anchors, then all tips |
    | ``positions`` | ``(2 J, 3)``, m, in the body's frame |

    Args:
        scene: a robot whose contacts follow the penalty law and whose bodies have at most
            one joint each: hinges, slides, a floating base.

    Raises:
        ValueError: another kind of robot or contact.
    """

    law: Tensor
    carries: Tensor
    is_slide: Tensor

    def __init__(self, scene: Scene) -> None:
        super().__init__()
        model, base = scene.model, scene.base
        joints = [j for j in range(model.njnt) if model.jnt_type[j] in (HINGE, SLIDE)]
        if len(joints) + base.is_floating < model.njnt or (model.body_jntnum > 1).any():
            raise ValueError(
                f"expected hinges and slides, one to a body, under foreseen forces, got "
                f"scene '{scene.name}' with others"
            )
        bodies = [int(model.jnt_bodyid[j]) for j in joints]
        anchor, axis = model.jnt_pos[joints], model.jnt_axis[joints]
        self.is_floating, self.bodies = base.is_floating, bodies + bodies
        self.positions = np.concatenate((anchor, anchor + axis))
        law = PenaltyLaw.of_bodies(model, scene.contacts.bodies)
        merged = [
            scene.contacts.stands_for.count(i) for i in range(len(scene.contacts))
        ]
        numbers = law.stiffness, law.damping, law.slip, law.friction, merged
        below = [
            [_is_below(model, b, j) for b in scene.contacts.bodies] for j in bodies
        ]
        carried = np.array(below).reshape(len(joints), len(scene.contacts))
        slides = model.jnt_type[joints] == SLIDE
        constants = {"law": np.stack(numbers), "carries": carried, "is_slide": slides}
        for name, value in constants.items():
            tensor = torch.as_tensor(np.array(value, dtype=np.float64))
            self.register_buffer(name, tensor, persistent=False)

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
            places: of anchors and tips, ``(*batch, 2 J, 3)``, m.
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


def _is_below(model: mujoco.MjModel, body: int, ancestor: int) -> bool:
    """Whether a body moves with another one."""
    while body and body != ancestor:
        body = int(model.body_parentid[body])
    return body == ancestor
