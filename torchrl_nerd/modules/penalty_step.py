"""A cheap simulator step in torch: one free body on level ground, springs at its points.

Each contact point that is in the ground is pushed out by a spring and a damper and held
back by friction, ``min(kf * slip, mu * normal force)``: the law of the paper's engine, see
`scenes.penalty`. A few substeps with a backward Euler spring are stable at any stiffness.
Every operation is differentiable, and so are the physical parameters: a rollout through it
fits them to recordings.
"""

import numpy as np
import torch
from torch import Tensor, nn

from torchrl_nerd.geometry.frames import quat_normalize
from torchrl_nerd.scenes.scene import Scene

PARAMETERS = ("gravity", "size", "inertia", "friction", "stiffness", "damping", "slip")
# what a unit of ``raw`` changes a parameter's logarithm by: those that tosses tell well
# move little, so that one step size suits all
SHARE = (0.1, 0.1, 0.5, 0.3, 2.0, 2.0, 4.0)
GROUND_SHARE = 0.005  # m, the same for the ground's height
SLOWEST = 1e-4  # m/s: keeps the direction of slip defined at rest

# rotation matrix, row by row, from the 16 products of a quaternion's entries
_MATRIX = torch.zeros(16, 9, dtype=torch.float64)
for _entry, _terms in enumerate(
    (
        {0: 1, 5: 1, 10: -1, 15: -1},
        {6: 2, 3: -2},
        {7: 2, 2: 2},
        {6: 2, 3: 2},
        {0: 1, 5: -1, 10: 1, 15: -1},
        {11: 2, 1: -2},
        {7: 2, 2: -2},
        {11: 2, 1: 2},
        {0: 1, 5: -1, 10: -1, 15: 1},
    )
):
    for _product, _factor in _terms.items():
        _MATRIX[_product, _entry] = _factor
# q (0, w) from the 12 products of q's and w's entries
_SPIN = torch.zeros(12, 4, dtype=torch.float64)
for _index, (_row, _sign) in enumerate(
    (
        *((1, 1), (2, 1), (3, 1), (0, -1), (3, 1), (2, -1)),
        *((3, -1), (0, -1), (1, 1), (2, 1), (1, -1), (0, -1)),
    )
):
    _SPIN[_index, _row] = _sign


class PenaltyStep(nn.Module):
    """One control step of a single free body above the plane z = 0.

    ``raw (8,)`` times `SHARE` is the logarithm of what multiplies the scene's own
    `PARAMETERS`; the last number times `GROUND_SHARE` is the height of the ground, m. All
    zero for the scene as it is.

    Args:
        scene: a single free body with point contacts that follow the penalty law.
        substeps: steps per control step.

    Raises:
        ValueError: another kind of robot or contact.
    """

    points: Tensor
    inertia: Tensor
    nominal: Tensor
    share: Tensor
    matrix: Tensor
    spin: Tensor

    def __init__(self, scene: Scene, substeps: int = 4) -> None:
        super().__init__()
        model, name = scene.model, scene.name
        if model.njnt != 1 or not scene.base.is_floating or len(scene.contacts) == 0:
            raise ValueError(
                f"expected a single free body on a ground, got scene '{name}'"
            )
        body = int(model.jnt_bodyid[0])
        geom = int(np.flatnonzero(model.geom_bodyid == body)[0])
        solref, weight = model.geom_solref[geom], model.body_invweight0[body, 0]
        if solref[0] >= 0.0:
            raise ValueError(
                f"expected penalty contacts, got scene '{name}' with others"
            )
        stiffness, damping = -solref / weight
        values = {
            "gravity": -model.opt.gravity[2],
            "size": 1.0,
            "inertia": 1.0,
            "friction": model.geom_friction[geom, 0],
            "stiffness": stiffness,
            "damping": damping,
            "slip": damping * model.opt.impratio,
        }
        self.substeps, self.step_size = substeps, scene.control_step / substeps
        self.mass = float(model.body_mass[body])
        points = torch.as_tensor(scene.contacts.positions, dtype=torch.float64)
        inertia = torch.as_tensor(model.body_inertia[body], dtype=torch.float64)
        reach = points.square().sum(-1).amax() / inertia.amin()
        self.lightest = float(1.0 / (1.0 / self.mass + reach))  # kg, at a point
        nominal = torch.tensor([values[key] for key in PARAMETERS], dtype=torch.float64)
        for key, value in (
            ("points", points.clone()),
            ("inertia", inertia.clone()),
            ("nominal", nominal),
            ("share", torch.tensor(SHARE, dtype=torch.float64)),
            ("matrix", _MATRIX),
            ("spin", _SPIN),
        ):
            self.register_buffer(key, value.clone(), persistent=False)
        count = len(PARAMETERS) + 1
        self.raw = nn.Parameter(torch.zeros(count, dtype=torch.float64))

    def scaled(self) -> Tensor:
        """The `PARAMETERS` in SI units; size and inertia as multiples of the scene's.

        The height of the ground (m) comes last.
        """
        factors = (self.share * self.raw[:-1]).exp()
        return torch.cat((self.nominal * factors, GROUND_SHARE * self.raw[-1:]))

    def values(self) -> dict[str, float]:
        """`scaled` by name."""
        names = (*PARAMETERS, "ground")
        return dict(zip(names, self.scaled().tolist(), strict=True))

    @torch.no_grad()
    def set_values(self, values: dict[str, float]) -> None:
        """Take over parameters as `values` gives them."""
        wanted = self.nominal.new_tensor([values[key] for key in PARAMETERS])
        self.raw[:-1] = (wanted / self.nominal).log() / self.share
        self.raw[-1] = values["ground"] / GROUND_SHARE

    def forward(self, qpos: Tensor, qvel: Tensor) -> tuple[Tensor, Tensor]:
        """The state one control step later, ``(rows, 7), (rows, 6)``, float64.

        The backward Euler spring foresees its own push but not the weight on it, so that a
        body at rest lies deeper than its stiffness says: 2.3 mm with the scene's damping,
        0.2 mm with that of the shipped model.
        """
        gravity, size, heavier, mu, ke, kd, kf, ground = self.scaled().unbind()
        h, points = self.step_size, size * self.points
        inertia = heavier * self.inertia
        soften = 1.0 + h * (kd + h * ke) / self.lightest  # backward Euler at a point
        spring, damper = ke / soften, (kd + h * ke) / soften
        slip = kf / (1.0 + h * kf / self.lightest)
        cross = _cross_matrices(points)  # (P, 3, 3): w -> w x point
        velocities = cross.reshape(-1, 3).mT  # (3, 3 P)
        torques = cross.reshape(-1, 3)  # force -> point x force, (3 P, 3)
        fall = torch.zeros_like(qvel[:1, :3])
        fall[:, 2] = 1.0
        fall = fall * (h * gravity)
        position, quat = qpos[:, :3], qpos[:, 3:]
        linear, angular = qvel[:, :3], qvel[:, 3:]
        for _ in range(self.substeps):
            products = (quat[:, :, None] * quat[:, None]).flatten(1)
            rotation = (products @ self.matrix).unflatten(1, (3, 3))
            up = rotation[:, 2]  # of the world, in body axes
            in_body = (linear[:, None] @ rotation)[:, 0]
            depth = ground - position[:, 2:] - up @ points.mT
            moving = (angular @ velocities).unflatten(1, (-1, 3)) + in_body[:, None]
            rising = (moving @ up[:, :, None])[..., 0]
            sliding = moving - rising[..., None] * up[:, None]
            speed = (sliding.square().sum(-1) + SLOWEST**2).sqrt()
            normal = (spring * depth - damper * rising).clamp_min(0.0)
            normal = torch.where(depth > 0.0, normal, 0.0)
            drag = torch.minimum(slip, mu * normal / speed)
            drag = torch.where(depth > 0.0, drag, 0.0)
            force = normal[..., None] * up[:, None] - drag[..., None] * sliding
            push = (rotation @ force.sum(1)[..., None])[..., 0]
            linear = linear + (h / self.mass) * push - fall
            gyro = torch.linalg.cross(angular, inertia * angular)
            angular = angular + h * (force.flatten(1) @ torques - gyro) / inertia
            position = position + h * linear
            turn = (quat[:, :, None] * (0.5 * h * angular)[:, None]).flatten(1)
            quat = quat_normalize(quat + turn @ self.spin)
        return torch.cat((position, quat), 1), torch.cat((linear, angular), 1)


def _cross_matrices(points: Tensor) -> Tensor:
    """Matrices of ``w -> w x point``, ``(P, 3) -> (P, 3, 3)``."""
    x, y, z = points.unbind(-1)
    o = torch.zeros_like(x)
    rows = (o, z, -y, -z, o, x, y, -x, o)
    return torch.stack(rows, -1).unflatten(-1, (3, 3))
