"""A control step during which nothing touches a robot: two looks at its motion.

MuJoCo's semi-implicit Euler moves on by the accelerations at the starts of its n substeps.
Their mean is, to second order, the acceleration at the mean of those times, (h - h/n) / 2.
So the first look, at the start, tells the state there, and the second one the mean: a
midpoint rule that shares the error of the substeps in place of adding its own. What pushes
at the ends of joints changes faster, and is found anew a few times.
"""

import mujoco
import numpy as np
import torch
from torch import Tensor, nn

from torchrl_nerd.geometry.base import BasePose
from torchrl_nerd.geometry.constants import keep_constants
from torchrl_nerd.geometry.elimination import inverted
from torchrl_nerd.geometry.free_motion import FreeMotion, rows_last
from torchrl_nerd.geometry.joint_axes import JointAxes
from torchrl_nerd.geometry.kinematics import PointKinematics
from torchrl_nerd.geometry.manifold import integrate_pos
from torchrl_nerd.modules.joint_stops import JointStops
from torchrl_nerd.scenes.contact_points import own_contacts
from torchrl_nerd.scenes.scene import Scene

EXACT = (int(mujoco.mjtIntegrator.mjINT_RK4),)  # no first-order error of its substeps


class FreeStep(nn.Module):
    """The next state under given torques, if no ground pushes.

    Limits push joints of a robot without a free base, see `JointStops`; those of one with
    it are left out.

    | buffer | meaning |
    |---|---|
    | ``lag`` | s, of a substep with the first-order error that the step shares; saved with
      a model: it is that of the truth it learned from |

    Args:
        scene: a robot of hinges and slides, on a free base or a fixed one, without dry
            friction.

    Raises:
        ValueError: in one sentence, another robot.
    """

    lag: Tensor
    low: Tensor
    high: Tensor

    def __init__(self, scene: Scene) -> None:
        super().__init__()
        expect_none(scene, untold_pushes(scene))
        model, self.period = scene.model, scene.control_step
        is_exact = model.opt.integrator in EXACT
        lag = torch.tensor(0.0 if is_exact else model.opt.timestep, dtype=torch.float64)
        self.register_buffer("lag", lag)
        axes = JointAxes.of(model, scene.base)
        self.num_places = len(axes.bodies)
        self.motion = FreeMotion(model, scene.base, axes, scene.actuated)
        bodies = axes.bodies + self.motion.bodies
        positions = np.concatenate((axes.positions, self.motion.positions))
        self.kinematics = PointKinematics(model, scene.base, bodies, positions)
        self.pose, self.layout = (
            BasePose(scene.base, scene.fixed_base_pose),
            scene.layout,
        )
        is_limited = model.jnt_limited[axes.joints] != 0
        self.stops, self.parts = None, 1
        if is_limited.any() and not scene.base.is_floating:
            # the scene's own, so that a model of a finer teacher is the same in both
            own = scene.control_step / (scene.substeps // scene.reference_ratio)
            self.stops = JointStops(model, axes, own)
            self.parts = self.stops.parts(self.period)
        low, high = model.jnt_range[axes.joints].T
        margin = model.jnt_margin[axes.joints]
        low = np.where(is_limited, low + margin, -np.inf)
        keep_constants(self, low=low, high=np.where(is_limited, high - margin, np.inf))

    def forward(
        self, qpos: Tensor, qvel: Tensor, joint_torque: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The next state, and two signs of what it leaves out.

        Args:
            qpos: ``(*batch, nq)``.
            qvel: ``(*batch, nv)``.
            joint_torque: ``(*batch, num_actuated)``, held over the step.

        Returns:
            The next ``qpos`` and ``qvel``; by how much the second look changed velocities,
            ``(*batch, nv)``; how far the step begins or ends beyond a limit,
            ``(*batch, 1)``, m or rad.
        """
        ahead = 0.5 * (self.period - self.lag)
        state, parts = (qpos, qvel), self.parts
        start = self._look(*state, joint_torque, 2.0 * ahead)
        middle = self._move(*state, start, ahead, parts // 2)
        look = self._look(*middle, joint_torque, 2.0 * self.lag)
        after, velocity = self._move(*state, look, self.period, parts)
        changed = self.period * (look[0] - start[0])
        return after, velocity, changed, self._beyond(qpos, after)

    def is_within(self, qpos: Tensor) -> Tensor:
        """Whether no joint is beyond a limit, ``(*batch,)``."""
        joints = qpos[..., self.motion.qpos_addresses]
        return ((joints >= self.low) & (joints <= self.high)).all(-1)

    def _beyond(self, before: Tensor, after: Tensor) -> Tensor:
        first, last = (x[..., self.motion.qpos_addresses] for x in (before, after))
        below = self.low - torch.minimum(first, last)
        above = torch.maximum(first, last) - self.high
        none = torch.zeros_like(before[..., :1])  # a robot may have no joints
        return torch.cat((none, below, above), -1).amax(-1, keepdim=True)

    def _look(
        self, qpos: Tensor, qvel: Tensor, joint_torque: Tensor, period: Tensor
    ) -> tuple[Tensor, Tensor | None]:
        """The free acceleration ``(*batch, nv)``; what turns forces into more of it.

        That is the mass matrix's inverse, ``(nv, nv, N)``, where limits may push.
        """
        points, _ = self.kinematics(qpos, qvel)
        count = points.shape[-2] - self.num_places
        places, corners = points.split((self.num_places, count), -2)
        _, rotation = self.pose(qpos)
        seen = qpos, qvel, joint_torque, rotation, corners, places, period
        if self.stops is None:
            return self.motion(*seen), None
        inverse, acceleration = inverted(*self.motion.equation(*seen))
        return acceleration.movedim(0, -1).reshape(qvel.shape), inverse

    def _move(
        self,
        qpos: Tensor,
        qvel: Tensor,
        look: tuple[Tensor, Tensor | None],
        period: float | Tensor,
        parts: int,
    ) -> tuple[Tensor, Tensor]:
        """The state a time later, of what was seen at one look."""
        acceleration, inverse = look
        if self.stops is None or inverse is None:
            moved = period * (qvel + 0.5 * (period + self.lag) * acceleration)
            place = integrate_pos(self.layout, qpos, moved)
            return place, qvel + period * acceleration
        rows = [rows_last(x, 1) for x in (qpos, qvel, acceleration)]
        state = self.stops(*rows, inverse, period, parts, self.lag)
        place, speed = (x.movedim(0, -1).reshape(qpos.shape) for x in state)
        return place, speed


def untold_pushes(scene: Scene) -> dict[str, bool]:
    """What `FreeStep` cannot tell of what may push a robot that touches no ground."""
    model = scene.model
    return {
        "dry friction": bool(model.dof_frictionloss.any()),
        "air or water": bool(model.opt.density or model.opt.viscosity),
        "parts that touch each other": len(own_contacts(model)) > 0,
        "gravity compensation": bool(model.body_gravcomp.any()),
    }


def expect_none(scene: Scene, pushes: dict[str, bool]) -> None:
    """Raise ValueError, in one sentence, where something is there that pushes a robot."""
    found = [what for what, is_there in pushes.items() if is_there]
    if found:
        raise ValueError(
            "expected a robot that motors, gravity, springs, damping and limits alone "
            f"move, got scene '{scene.name}' with {', '.join(found)}"
        )
