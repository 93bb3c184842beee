"""A control step of a robot that nothing touches, from two looks at its free motion.

MuJoCo's semi-implicit Euler moves on by the accelerations at the starts of its n substeps.
Their mean is, to second order, the acceleration at the mean of those times, (h - h/n) / 2.
So the first look, at the start, tells the state there, and the second one the mean: a
midpoint rule that shares the error of the substeps in place of adding its own.
"""

import mujoco
import numpy as np
import torch
from torch import Tensor, nn

from torchrl_nerd.geometry.constants import keep_constants
from torchrl_nerd.geometry.free_motion import FreeMotion
from torchrl_nerd.geometry.joint_axes import JointAxes
from torchrl_nerd.geometry.kinematics import PointKinematics
from torchrl_nerd.scenes.contact_points import own_contacts
from torchrl_nerd.scenes.scene import Scene

EXACT = (int(mujoco.mjtIntegrator.mjINT_RK4),)  # no first-order error of its substeps


class FreeStep(nn.Module):
    """The change of the state under given torques, in the numbers of `StateDelta`.

    | buffer | meaning |
    |---|---|
    | ``lag`` | s, of a substep with the first-order error that the step shares; saved with
      a model: it is that of the truth it learned from |

    Args:
        scene: a fixed robot of hinges and slides without ground and friction.

    Raises:
        ValueError: in one sentence, another robot.
    """

    lag: Tensor
    rotation: Tensor
    low: Tensor
    high: Tensor

    def __init__(self, scene: Scene) -> None:
        super().__init__()
        _expect_free(scene)
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
        ends = np.where(
            model.jnt_limited != 0, model.jnt_range.T, [[-np.inf], [np.inf]]
        )
        keep_constants(self, rotation=scene.mount[1], low=ends[0], high=ends[1])

    def forward(
        self, qpos: Tensor, qvel: Tensor, joint_torque: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The change, and two signs of what it leaves out.

        Args:
            qpos: ``(*batch, nq)``.
            qvel: ``(*batch, nv)``.
            joint_torque: ``(*batch, num_actuated)``, held over the step.

        Returns:
            The change ``(*batch, 2 nv)``; by how much the second look changed that of
            velocities, ``(*batch, nv)``; how far the step begins or ends beyond a limit,
            which it does not see, ``(*batch, 1)``, m or rad.
        """
        ahead = 0.5 * (self.period - self.lag)
        start = self._acceleration(qpos, qvel, joint_torque, 2.0 * ahead)
        speed = qvel + ahead * start
        place = qpos + ahead * (qvel + 0.5 * (ahead + self.lag) * start)
        gain = self._acceleration(place, speed, joint_torque, 2.0 * self.lag)
        gain = self.period * gain
        residual = 0.5 * self.lag * gain
        after = qpos + self.period * (qvel + 0.5 * gain) + residual
        below = self.low - torch.minimum(qpos, after)
        above = torch.maximum(qpos, after) - self.high
        beyond = torch.maximum(below, above).amax(-1, keepdim=True).clamp_min(0.0)
        return torch.cat((gain, residual), -1), gain - self.period * start, beyond

    def _acceleration(
        self, qpos: Tensor, qvel: Tensor, joint_torque: Tensor, period: Tensor
    ) -> Tensor:
        points, _ = self.kinematics(qpos, qvel)
        count = points.shape[-2] - self.num_places
        places, corners = points.split((self.num_places, count), -2)
        rotation = self.rotation.expand(*qpos.shape[:-1], 3, 3)
        return self.motion(qpos, qvel, joint_torque, rotation, corners, places, period)


def _expect_free(scene: Scene) -> None:
    model = scene.model
    air = model.opt.density or model.opt.viscosity
    there = {
        "a floating base": scene.base.is_floating,
        "a ground": scene.terrain is not None,
        "dry friction": model.dof_frictionloss.any(),
        "air or water": air,
        "parts that touch each other": len(own_contacts(model)),
        "gravity compensation": model.body_gravcomp.any(),
    }
    found = [what for what, is_there in there.items() if is_there]
    if found:
        raise ValueError(
            "expected a robot that motors, gravity, springs, damping and limits alone "
            f"move, got scene '{scene.name}' with {', '.join(found)}"
        )
