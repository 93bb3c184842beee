"""Where a robot's bodies are and how they move, in the world, for rewards of tensors."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from torchrl_nerd.geometry.base import BasePose, keep_constants, over_ground
from torchrl_nerd.geometry.kinematics import PointKinematics
from torchrl_nerd.geometry.motion import cross, rotate_by
from torchrl_nerd.scenes import Scene


class Motion(NamedTuple):
    """Of n bodies, in world axes; columns of a rotation are a body's axes."""

    position: Tensor  # (*batch, n, 3), m, of the frames' origins
    rotation: Tensor  # (*batch, n, 3, 3)
    com: Tensor  # (*batch, 3), m, centre of mass of the whole robot
    com_velocity: Tensor  # (*batch, 3), m/s


class BodyMotion(nn.Module):
    """`Motion` of the named moving bodies of a scene's robot, one pass of kinematics."""

    centre: Tensor  # (3, bodies, 1), m, of mass, in the body
    share: Tensor  # (bodies, 1), of the robot's mass

    def __init__(self, scene: Scene, names: tuple[str, ...] = ()) -> None:
        super().__init__()
        model, self.base = scene.model, scene.base
        moving = np.flatnonzero(model.body_dofnum[model.body_weldid]).tolist()
        self.places = [moving.index(model.body(name).id) for name in names]
        centres, mass = model.body_ipos[moving], model.body_mass[moving]
        self.kinematics = PointKinematics(model, scene.base, moving, centres)
        self.pose = BasePose(model, scene.base)
        share = mass[:, None] / mass.sum()
        keep_constants(self, centre=centres.T[..., None], share=share)

    def forward(self, qpos: Tensor, qvel: Tensor) -> Motion:
        """Of ``qpos (*batch, nq)`` and ``qvel (*batch, nv)``."""
        batch = qpos.shape[:-1]
        q, v = (x.reshape(-1, x.shape[-1]) for x in (qpos, qvel))
        columns = q.T.contiguous(), v.T.contiguous()
        origin, turn, omega, velocity = self.kinematics.body_motion(*columns)
        arm = rotate_by(turn, self.centre)  # (3, n, N)
        com, com_velocity = (
            (self.share * x).sum(1).T  # (N, 3), in B_t and relative to it
            for x in (origin + arm, velocity + cross(omega, arm))
        )
        place, base = self.pose(q)  # (N, 3), (N, 3, 3)
        moves = com_velocity[:, None], base
        com_velocity = over_ground(self.base, v, com[:, None], *moves)[:, 0]
        origin, turn = origin[:, self.places], turn[:, :, self.places]
        position = origin.permute(2, 1, 0) @ base.mT + place[:, None]
        found = (
            position,
            base[:, None] @ turn.permute(3, 2, 0, 1),
            (base @ com[..., None])[..., 0] + place,
            (base @ com_velocity[..., None])[..., 0],
        )
        return Motion(*(x.reshape(*batch, *x.shape[1:]) for x in found))


def tolerance(
    x: Tensor,
    low: float = 0.0,
    high: float = 0.0,
    margin: float = 0.0,
    at_margin: float = 0.1,
    shape: str = "gaussian",
) -> Tensor:
    """1 from ``low`` to ``high``, and less outside: ``at_margin`` at a ``margin`` from it.

    With the distance d in margins and v = ``at_margin``: v^(d^2) (gaussian), or
    max(1 - (1 - v) d^p, 0) with p = 1 (linear) or 2 (quadratic). Without a margin 0.
    Source: Tassa et al., "DeepMind Control Suite" (2018), section 4.
    """
    distance = torch.maximum(low - x, x - high).clamp_min(0.0)
    if margin == 0.0:
        return (distance == 0.0).to(x)
    d = distance / margin
    if shape == "gaussian":
        return torch.pow(torch.full_like(d, at_margin), d * d)
    power = {"linear": d, "quadratic": d * d}[shape]
    return (1.0 - (1.0 - at_margin) * power).clamp_min(0.0)
