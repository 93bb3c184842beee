"""One free body over level ground with penalty contacts, and parameters to fit.

The contact law is that of `scenes.penalty_law`, plus two properties of real bodies: a
centre of mass that is not the body frame's origin, and friction that fades under load,
``mu / (1 + normal force * fading)``, as that of elastic asperities (J. F. Archard,
"Elastic deformation and the laws of friction", 1957). A few substeps with a backward
Euler spring are stable at any stiffness. Every operation is differentiable, also in the
physical parameters.
"""

import mujoco
import numpy as np
import torch
from torch import Tensor, nn

from torchrl_nerd.analytic.base import AnalyticStep, StepResult, check_supported
from torchrl_nerd.configs import FreeBodyConfig
from torchrl_nerd.geometry.base import keep_constants
from torchrl_nerd.geometry.rotations import (
    quat_conjugate,
    quat_multiply,
    quat_normalize,
)
from torchrl_nerd.scenes import penalty_law
from torchrl_nerd.scenes.scene import Scene
from torchrl_nerd.settings import expect_count

# what a unit of ``raw`` changes a parameter's logarithm by: those that tosses tell well
# move little, so that one step size suits all
SCALED = {
    "gravity": 0.1,
    "size": 0.1,
    "inertia": 0.5,
    "friction": 0.3,
    "stiffness": 2.0,
    "damping": 2.0,
    "slip": 4.0,
}
# what a unit of ``raw`` is of the parameters that are zero in a scene
SHIFTED = {
    "ground": 0.005,  # m, its height
    "centre_x": 0.005,  # m, of mass, in body axes
    "centre_y": 0.005,
    "centre_z": 0.005,
    "fading": 0.01,  # 1/N, of friction under load
}
PARAMETERS = (*SCALED, *SHIFTED)
MIN_SLIP = 1e-4  # m/s: keeps the direction of slip defined at rest


class FreeBodyPenaltyStep(AnalyticStep):
    """One control step of a single free body above the plane z = 0; see `AnalyticStep`.

    ``velocity_defect (*batch, 6)`` is the velocity change by contact, linear in world axes,
    angular in the body's.

    ``raw (12,)`` holds the `PARAMETERS`: the logarithms of what multiplies the scene's own,
    in units of `SCALED`, then those that scenes lack, in units of `SHIFTED`. All zero for
    the scene as it is.

    The scene is a single free body with point contacts that follow the penalty law;
    ``num_substeps`` are semi-implicit Euler steps per control step.

    Raises:
        ValueError: another kind of robot or contact.
    """

    compile_single_threaded: bool = False
    points: Tensor  # (P, 3), m, body frame
    inertia: Tensor  # (3,), kg m^2
    nominal: Tensor  # (7,): the scene's own parameters
    share: Tensor  # (7,)
    shift: Tensor  # (5,)
    matrix: Tensor  # (16, 9)
    spin: Tensor  # (12, 4)

    def __init__(self, scene: Scene, num_substeps: int = 8) -> None:
        expect_count(1, num_substeps=num_substeps)
        super().__init__(scene, FreeBodyConfig(num_substeps), num_defects=6)
        model = scene.model
        check_supported(scene)
        if model.njnt != 1 or not scene.base.is_floating or len(scene.contacts) == 0:
            raise ValueError(
                f"expected a single free body on a ground, got scene '{scene.name}'"
            )
        body, odd = int(model.jnt_bodyid[0]), _other_than_modelled(scene)
        if found := [name for name, is_there in odd.items() if is_there]:
            raise ValueError(
                "expected a free body of corners over the plane z = 0, with its centre of "
                f"mass at its origin, got scene '{scene.name}' with {', '.join(found)}"
            )
        law = penalty_law.PenaltyLaw.of_bodies(model, [body])
        contact = law.friction, law.stiffness, law.damping, law.slip
        self.num_substeps = num_substeps
        self.step_size = scene.control_step / num_substeps
        self.mass = float(model.body_mass[body])
        points, inertia = scene.contacts.positions, model.body_inertia[body]
        reach = (points**2).sum(-1).max() / inertia.min()
        self.lightest = float(1.0 / (1.0 / self.mass + reach))  # kg, at a point
        # a quaternion's entries
        one = torch.eye(4, dtype=torch.float64, device="cpu")
        turned = quat_multiply(one[1:], quat_conjugate(one)[:, None])  # (4, axis, 4)
        turned = quat_multiply(one[:, None, None], turned)[..., 1:]  # (4, 4, axis, 3)
        keep_constants(
            self,
            points=points,
            inertia=inertia,
            nominal=[-model.opt.gravity[2], 1.0, 1.0, *(x.item() for x in contact)],
            share=[*SCALED.values()],
            shift=[*SHIFTED.values()],
            # rotation matrix, row by row, from the 16 products of a quaternion's entries
            matrix=turned.mT.reshape(16, 9).numpy(),
            # q (0, w) from the 12 products of q's and w's entries
            spin=quat_multiply(one[:, None], one[1:]).reshape(12, 4).numpy(),
        )
        self.raw = nn.Parameter(torch.zeros(len(PARAMETERS), dtype=torch.float64))

    def scaled(self) -> Tensor:
        """The `PARAMETERS` ``(12,)``, SI units; size and inertia per the scene's."""
        count = len(SCALED)
        factors = (self.share * self.raw[:count]).exp()
        return torch.cat((self.nominal * factors, self.shift * self.raw[count:]))

    def values(self) -> dict[str, float]:
        """`scaled` by name."""
        return dict(zip(PARAMETERS, self.scaled().tolist(), strict=True))

    @torch.no_grad()
    def set_values(self, values: dict[str, float]) -> None:
        """Take over parameters as `values` gives them; those not named stay.

        Raises:
            ValueError: an unknown name, or a number out of its range.
        """
        for name, value in values.items():
            if name not in PARAMETERS:
                known = ", ".join(PARAMETERS)
                raise ValueError(f"expected parameters of {known}, got '{name}'")
            at = PARAMETERS.index(name)
            if at < len(SCALED):
                raw = np.log(value / self.nominal[at].item()) if value > 0.0 else np.nan
                raw /= self.share[at].item()
            else:
                raw = value / self.shift[at - len(SCALED)].item()
            if not np.isfinite(raw):
                positive = " above 0" if at < len(SCALED) else ""
                raise ValueError(f"expected a finite {name}{positive}, got {value}")
            self.raw[at] = raw

    def _step(
        self, qpos: Tensor, qvel: Tensor, torque: Tensor | None, ground: Tensor | None
    ) -> StepResult:
        """See `AnalyticStep`; a free body has no torque and no other ground.

        The backward Euler spring adds ``h k`` to the damping, which is small only beside
        ``mass / substep``: 90 N s/m at a corner of the measured cube.
        """
        scaled = self.scaled()
        gravity, size, heavier, mu, ke, kd, kf, floor, *_, fading = scaled.unbind()
        centre, inertia = scaled[-4:-1], heavier * self.inertia
        h, points = self.step_size, size * self.points - centre
        soften = 1.0 + h * (kd + h * ke) / self.lightest  # backward Euler at a point
        spring, damper = ke / soften, (kd + h * ke) / soften
        slip = kf / (1.0 + h * kf / self.lightest)
        axes = torch.eye(3, dtype=points.dtype, device=points.device)
        cross = torch.linalg.cross(points[:, None], axes[None])  # w -> w x point
        cross = cross.reshape(-1, 3)  # (3 P, 3): force -> point x force
        fall = axes[2] * (h * gravity)
        quat, angular = qpos[:, 3:], qvel[:, 3:]
        rotation = self._rotation(quat)
        position = qpos[:, :3] + rotation @ centre
        linear = qvel[:, :3] + _swing(rotation, angular, centre)
        by_contact = torch.zeros_like(qvel)
        for _ in range(self.num_substeps):
            linear = linear - fall
            up = rotation[:, 2]  # (N, 3), of the world, in body axes
            in_body = (linear[:, None] @ rotation)[:, 0]
            depth = floor - position[:, 2:] - up @ points.mT  # (N, P)
            moving = (angular @ cross.mT).unflatten(1, (-1, 3)) + in_body[:, None]
            rising = (moving @ up[:, :, None])[..., 0]
            sliding = moving - rising[..., None] * up[:, None]  # (N, P, 3)
            speed = (sliding.square().sum(-1) + MIN_SLIP**2).sqrt()
            normal_force = penalty_law.normal_force(spring, damper, depth, rising)
            faded = mu / (1.0 + fading * normal_force)
            stick = slip, faded
            friction_force = penalty_law.friction_force(*stick, normal_force, speed)
            per_slip = (friction_force / speed)[..., None]
            force = normal_force[..., None] * up[:, None] - per_slip * sliding
            total_force = (rotation @ force.sum(1)[..., None])[..., 0]
            moment = force.flatten(1) @ cross
            change = torch.cat(((h / self.mass) * total_force, h * moment / inertia), 1)
            by_contact = by_contact + change
            gyro = torch.linalg.cross(angular, inertia * angular)
            linear = linear + change[:, :3]
            angular = angular + change[:, 3:] - h * gyro / inertia
            position = position + h * linear
            turn = (quat[:, :, None] * (0.5 * h * angular)[:, None]).flatten(1)
            quat = quat_normalize(quat + turn @ self.spin)
            rotation = self._rotation(quat)
        position = position - rotation @ centre
        linear = linear - _swing(rotation, angular, centre)
        after = torch.cat((position, quat), 1), torch.cat((linear, angular), 1)
        return StepResult(*after, by_contact)

    def _rotation(self, quat: Tensor) -> Tensor:
        """Rotation matrices ``(N, 3, 3)``, body to world."""
        products = (quat[:, :, None] * quat[:, None]).flatten(1)  # (N, 16)
        return (products @ self.matrix).unflatten(1, (3, 3))


def _swing(rotation: Tensor, angular: Tensor, point: Tensor) -> Tensor:
    """Velocity ``(N, 3)``, world, of a point of the body beside its origin's."""
    moving = torch.linalg.cross(angular, point.expand_as(angular))
    return (rotation @ moving[..., None])[..., 0]


def _other_than_modelled(scene: Scene) -> dict[str, bool]:
    """What the step does not know of, and whether it is there."""
    model, body = scene.model, int(scene.model.jnt_bodyid[0])
    plane = None if scene.terrain is None else scene.terrain.fixed_plane
    is_level = plane is not None and np.allclose(plane, (0.0, 0.0, 1.0, 0.0))
    pose = (*model.body_ipos[body], *model.body_iquat[body])
    is_centred = np.allclose(pose, (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0))
    return {
        "another ground": not is_level,
        "round shapes": bool(scene.contacts.radii.any()),
        "axes of inertia of their own": not is_centred,
        "gravity to the side": bool(model.opt.gravity[:2].any()),
        "damping": bool(model.dof_damping.any()),
        "armature": bool(model.dof_armature.any()),
        "pyramidal friction cones": model.opt.cone != mujoco.mjtCone.mjCONE_ELLIPTIC,
    }
