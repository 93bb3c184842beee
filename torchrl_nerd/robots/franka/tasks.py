"""Franka brings its hand to a point that is drawn at each reset. Paper, appendix B."""

from functools import cached_property

import torch
from torch import Tensor

from torchrl_nerd.geometry.constants import constant, placed
from torchrl_nerd.geometry.kinematics import PointKinematics
from torchrl_nerd.geometry.rotations import wrap_angle
from torchrl_nerd.keys import GOAL, QPOS, QVEL
from torchrl_nerd.robots.franka.scene import GAIN, HOME, franka, franka_gravity
from torchrl_nerd.scenes.controllers import PDController
from torchrl_nerd.scenes.operational_space import OperationalSpaceController
from torchrl_nerd.tasks.floating import between, symmetric
from torchrl_nerd.tasks.task import State, Task

START_SPREAD = 0.125  # rad about HOME
GOAL_LOW, GOAL_HIGH = (0.3, -0.35, 0.05), (0.7, 0.35, 0.45)  # m, world; reference code
EPSILON = 1e-4
KP = (600.0, 600.0, 600.0, 600.0, 250.0, 150.0, 50.0)  # N m/rad; reference code
KD = (5.0, 5.0, 5.0, 5.0, 3.0, 2.5, 1.5)  # N m s/rad
ACTION_SCALE = 0.03125  # rad per unit of action from the present position
HAND = "end_effector"  # the site between the fingertips
HAND_KP, HAND_KD = 400.0, 40.0  # 1/s^2 and 1/s: critically damped, 0.05 s
HAND_SCALE = 0.1  # m per unit of action, which leads to 1 m/s
GOAL_SPREAD = 0.5  # rad about HOME: joint positions whose hand is a goal


class FrankaReachTorque(Task):
    """Reward -d + 1/(e^50d + e^-50d + 1e-4) + 1/(e^300d + e^-300d + 1e-4).

    d is the distance (m) of the point between the fingertips to the goal. The action is
    torque, up to the effort limits. Observation: joint angles in [-pi, pi), the point,
    the goal; no velocities. Never terminated. 128 actions.
    """

    build_scene = staticmethod(franka)
    horizon = 128
    num_uniforms = 10
    observation_size = 13
    parameters = {GOAL: 3}

    def initial_state(self, u: Tensor) -> dict[str, Tensor]:
        """At rest near home; the goal is uniform in a box before the robot."""
        return {
            QPOS: constant(u, HOME) + symmetric(u[..., :7], START_SPREAD),
            QVEL: torch.zeros_like(u[..., :7]),
            GOAL: between(u[..., 7:], GOAL_LOW, GOAL_HIGH),
        }

    def end_effector(self, qpos: Tensor) -> Tensor:
        """The point between the fingertips, m, world, ``(*batch, 3)``."""
        still = qpos.new_zeros(0, qpos.shape[-1])  # no velocities: positions alone
        points, _ = placed(self._kinematics, qpos)(qpos, still)
        position, rotation = self.scene.base_pose(qpos)
        return position + (rotation @ points[..., 0, :, None]).squeeze(-1)

    @cached_property
    def _kinematics(self) -> PointKinematics:
        model = self.scene.model
        site = model.site(HAND)
        body = int(model.site_bodyid[site.id])
        return PointKinematics(model, self.scene.base, [body], site.pos[None])

    def observation(self, state: State) -> Tensor:
        """Joint angles, the point, the goal."""
        qpos = state[QPOS]
        return torch.cat((wrap_angle(qpos), self.end_effector(qpos), state[GOAL]), -1)

    def reward(self, state: State, action: Tensor, next_state: State) -> Tensor:
        """Of the state that the step led to."""
        offset = self.end_effector(next_state[QPOS]) - next_state[GOAL]
        distance = torch.linalg.vector_norm(offset, dim=-1)
        return -distance + _peak(50.0 * distance) + _peak(300.0 * distance)


class FrankaReach(FrankaReachTorque):
    """The same goal by small moves: springs pull to the present position + 0.03125 a.

    Each action holds for two control steps, and the target is taken anew from the
    position at each of them.
    """

    frame_skip = 2

    @property
    def controller(self) -> PDController:
        """Springs to a place near the present one, within the effort limits."""
        joints, scale = tuple(range(7)), (ACTION_SCALE,) * 7
        return PDController(joints, joints, KP, KD, scale, limit=GAIN)


class FrankaReachOSC(FrankaReachTorque):
    """The same reward by moves of the hand: the action is a displacement of 0.1 m a.

    An `OperationalSpaceController` turns it into torque, within the effort limits. Each of
    64 actions holds for four control steps, 1/30 s. Not in the paper.

    A goal is where the hand is at joint positions uniform within 0.5 rad of home and
    within the joint limits. So the arm reaches every goal, 0.15 m or more over the table.
    Observation: joint angles in [-pi, pi), the point, the way from it to the goal.
    """

    horizon, frame_skip = 64, 4
    num_uniforms = 14

    def initial_state(self, u: Tensor) -> dict[str, Tensor]:
        """At rest near home; the goal is the hand of another pose near home."""
        start = super().initial_state(u[..., :10])
        pose = constant(u, HOME) + symmetric(u[..., 7:], GOAL_SPREAD)
        return start | {GOAL: self.controller.site(pose).position}

    def observation(self, state: State) -> Tensor:
        """Joint angles, the point, the way to the goal."""
        angles, point, goal = super().observation(state).split((7, 3, 3), -1)
        return torch.cat((angles, point, goal - point), -1)

    @cached_property
    def controller(self) -> OperationalSpaceController:  # pyright: ignore
        """From displacements of the hand to torques within the effort limits."""
        kp, kd, scale = (HAND_KP,) * 3, (HAND_KD,) * 3, (HAND_SCALE,) * 3
        numbers = kp, kd, scale, HOME, GAIN
        return OperationalSpaceController(self.scene.model, HAND, *numbers)


class FrankaGravityReachTorque(FrankaReachTorque):
    """The torque task with the real arm's inertials, under gravity; not in the paper."""

    build_scene = staticmethod(franka_gravity)


def _peak(x: Tensor) -> Tensor:
    """About one half at zero, falling like e^-x; x must not be negative."""
    small = (-x).exp()  # never e^x, which overflows, and its slope with it
    return small / (1.0 + small.square() + EPSILON * small)
