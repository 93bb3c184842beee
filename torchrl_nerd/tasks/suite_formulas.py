"""Rewards and observations of suite tasks as functions of tensors, a class per domain.

The suite's own code reads a `Physics`, one env after the other, and costs 0.1 to 1 ms for
each. These are the same numbers, for all envs at once, on any device, and compile with the
rest of a step. Source of the formulas: dm_control 1.0, the modules of ``suite``.
"""

from abc import ABC, abstractmethod
from math import cos, inf, radians

import torch
from torch import Tensor

from torchrl_nerd.geometry.constants import constant, placed
from torchrl_nerd.scenes import Scene
from torchrl_nerd.tasks.body_motion import BodyMotion, Motion, tolerance

X, Z = 0, 2


class Formula(ABC):
    """Observation and reward of one task, named as in its domain, such as ``"walk"``."""

    bodies: tuple[str, ...] = ()  # whose places and axes it reads
    reads_forces: bool = False  # its observation, those of contact

    def __init__(self, scene: Scene, task: str) -> None:
        self.task = task
        self._motion = BodyMotion(scene, self.bodies)

    def motion(self, qpos: Tensor, qvel: Tensor) -> Motion:
        """Of `bodies`, see `BodyMotion`."""
        return placed(self._motion, qpos)(qpos, qvel)

    @abstractmethod
    def observation(self, qpos: Tensor, qvel: Tensor, extra: Tensor) -> Tensor:
        """The suite's, flattened in its order, ``(*batch, size)``.

        ``extra (*batch, k)``: the targets' positions, m, or the forces felt.
        """

    @abstractmethod
    def reward(self, qpos: Tensor, qvel: Tensor, ctrl: Tensor, extra: Tensor) -> Tensor:
        """The suite's, ``(*batch,)``, of the state that ``ctrl (*batch, nu)`` led to."""


class Acrobot(Formula):
    """The tip of a double pendulum goes to a point above it."""

    bodies = ("upper_arm", "lower_arm")

    def __init__(self, scene: Scene, task: str) -> None:
        super().__init__(scene, task)
        tip, target = (scene.model.site(name) for name in ("tip", "target"))
        self.tip, self.target = tip.pos.tolist(), target.pos.tolist()
        self.radius = float(target.size[0])

    def observation(self, qpos: Tensor, qvel: Tensor, extra: Tensor) -> Tensor:
        """Horizontal and vertical parts of both arms' z axes, velocities."""
        axis = self.motion(qpos, qvel).rotation[..., Z]  # (*batch, 2, 3)
        return torch.cat((axis[..., X], axis[..., Z], qvel), -1)

    def reward(self, qpos: Tensor, qvel: Tensor, ctrl: Tensor, extra: Tensor) -> Tensor:
        """By the tip's distance from the target."""
        arms = self.motion(qpos, qvel)
        arm = arms.rotation[..., 1, :, :] @ constant(qpos, self.tip)
        gap = arms.position[..., 1, :] + arm - constant(qpos, self.target)
        gap = torch.linalg.vector_norm(gap, dim=-1)
        margin = 0.0 if self.task.endswith("sparse") else 1.0
        return tolerance(gap, 0.0, self.radius, margin)


class Cartpole(Formula):
    """One or more poles stand on a cart in the middle of its rail."""

    def __init__(self, scene: Scene, task: str) -> None:
        model = scene.model
        poles = range(2, model.nbody)
        self.bodies = tuple(model.body(body).name for body in poles)
        super().__init__(scene, task)

    def observation(self, qpos: Tensor, qvel: Tensor, extra: Tensor) -> Tensor:
        """Cart, then vertical and horizontal part of each pole's z axis, velocities."""
        axis = self.motion(qpos, qvel).rotation[..., Z]  # (*batch, poles, 3)
        poles = torch.stack((axis[..., Z], axis[..., X]), -1).flatten(-2)
        return torch.cat((qpos[..., :1], poles, qvel), -1)

    def reward(self, qpos: Tensor, qvel: Tensor, ctrl: Tensor, extra: Tensor) -> Tensor:
        """Upright, centred, slow and with little force; or whether all is within bounds."""
        cart = qpos[..., 0]
        upright = self.motion(qpos, qvel).rotation[..., Z, Z]  # (*batch, poles)
        if self.task.endswith("sparse"):
            is_centred = tolerance(cart, -0.25, 0.25)
            return is_centred * tolerance(upright, 0.995, 1.0).prod(-1)
        centred = (1.0 + tolerance(cart, margin=2.0)) / 2.0
        small = tolerance(ctrl[..., 0], margin=1.0, at_margin=0.0, shape="quadratic")
        slow = (1.0 + tolerance(qvel[..., 1:], margin=5.0).amin(-1)) / 2.0
        return (upright.mean(-1) + 1.0) / 2.0 * (4.0 + small) / 5.0 * slow * centred


class Cheetah(Formula):
    """A planar cheetah runs."""

    def observation(self, qpos: Tensor, qvel: Tensor, extra: Tensor) -> Tensor:
        """Positions but for the place along the track, velocities."""
        return torch.cat((qpos[..., 1:], qvel), -1)

    def reward(self, qpos: Tensor, qvel: Tensor, ctrl: Tensor, extra: Tensor) -> Tensor:
        """Speed, up to 10 m/s."""
        speed = self.motion(qpos, qvel).com_velocity[..., X]
        return _moving(speed, 10.0, margin=10.0, at_margin=0.0)


class Hopper(Formula):
    """A planar hopper stands, or hops."""

    bodies = ("torso", "foot")
    reads_forces = True

    def __init__(self, scene: Scene, task: str) -> None:
        super().__init__(scene, task)
        self.centres = [scene.model.body(name).ipos.tolist() for name in self.bodies]

    def observation(self, qpos: Tensor, qvel: Tensor, extra: Tensor) -> Tensor:
        """Positions but for the place along the track, velocities, touch of the foot."""
        return torch.cat((qpos[..., 1:], qvel, extra.log1p()), -1)

    def reward(self, qpos: Tensor, qvel: Tensor, ctrl: Tensor, extra: Tensor) -> Tensor:
        """Torso above the foot, and speed up to 2 m/s or little force."""
        motion, centres = self.motion(qpos, qvel), constant(qpos, self.centres)
        height = (motion.rotation @ centres[..., None])[..., Z, 0]  # (*batch, 2)
        height = height + motion.position[..., Z]
        standing = tolerance(height[..., 0] - height[..., 1], 0.6, 2.0)
        if self.task == "hop":
            return standing * _moving(motion.com_velocity[..., X], 2.0, 1.0, 0.5)
        return standing * _small(ctrl)


class Humanoid(Formula):
    """A humanoid stands, walks or runs."""

    bodies = ("torso", "head", "left_hand", "left_foot", "right_hand", "right_foot")
    speed = {"stand": 0.0, "walk": 1.0}  # m/s; else it runs

    def observation(self, qpos: Tensor, qvel: Tensor, extra: Tensor) -> Tensor:
        """Joints, head's height, hands and feet from the torso, its z row, velocities."""
        if self.task.endswith("pure_state"):
            return torch.cat((qpos, qvel), -1)
        motion = self.motion(qpos, qvel)
        torso = motion.rotation[..., 0, :, :]
        ends = motion.position[..., 2:, :] - motion.position[..., :1, :]
        height, ends = motion.position[..., 1, Z:], (ends @ torso).flatten(-2)
        parts = qpos[..., 7:], height, ends, torso[..., Z, :], motion.com_velocity, qvel
        return torch.cat(parts, -1)

    def reward(self, qpos: Tensor, qvel: Tensor, ctrl: Tensor, extra: Tensor) -> Tensor:
        """Head high, torso upright, little force, and the task's speed in any direction."""
        motion = self.motion(qpos, qvel)
        standing = tolerance(motion.position[..., 1, Z], 1.4, inf, 0.35)
        leaning = motion.rotation[..., 0, Z, Z]
        upright = tolerance(leaning, 0.9, inf, 1.9, at_margin=0.0, shape="linear")
        posture = _small(ctrl) * standing * upright
        across, wanted = motion.com_velocity[..., :2], self.speed.get(self.task, 10.0)
        if wanted == 0.0:
            return posture * tolerance(across, margin=2.0).mean(-1)
        speed = torch.linalg.vector_norm(across, dim=-1)
        return posture * (5.0 * _moving(speed, wanted, wanted, 0.0) + 1.0) / 6.0


class Pendulum(Formula):
    """A pendulum stands up."""

    bodies = ("pole",)

    def observation(self, qpos: Tensor, qvel: Tensor, extra: Tensor) -> Tensor:
        """Vertical and horizontal part of the pole's z axis, velocity."""
        axis = self.motion(qpos, qvel).rotation[..., 0, :, Z]
        return torch.cat((axis[..., Z:], axis[..., :1], qvel), -1)

    def reward(self, qpos: Tensor, qvel: Tensor, ctrl: Tensor, extra: Tensor) -> Tensor:
        """Whether it is within 8 degrees of upright."""
        upright = self.motion(qpos, qvel).rotation[..., 0, Z, Z]
        return tolerance(upright, cos(radians(8.0)), 1.0)


class Reacher(Formula):
    """A planar arm's finger reaches a target."""

    bodies = ("finger",)

    def __init__(self, scene: Scene, task: str) -> None:
        super().__init__(scene, task)
        finger = scene.model.geom("finger")
        self.finger = finger.pos.tolist()
        self.radius = {"easy": 0.05, "hard": 0.015}[task] + float(finger.size[0])

    def observation(self, qpos: Tensor, qvel: Tensor, extra: Tensor) -> Tensor:
        """Positions, from finger to target, velocities."""
        return torch.cat((qpos, self._gap(qpos, qvel, extra), qvel), -1)

    def reward(self, qpos: Tensor, qvel: Tensor, ctrl: Tensor, extra: Tensor) -> Tensor:
        """Whether finger and target touch."""
        gap = torch.linalg.vector_norm(self._gap(qpos, qvel, extra), dim=-1)
        return tolerance(gap, 0.0, self.radius)

    def _gap(self, qpos: Tensor, qvel: Tensor, extra: Tensor) -> Tensor:
        """From the finger to the target, m, ``(*batch, 2)``."""
        motion = self.motion(qpos, qvel)
        arm = motion.rotation[..., 0, :, :] @ constant(qpos, self.finger)
        return extra[..., :2] - (motion.position[..., 0, :] + arm)[..., :2]


class Walker(Formula):
    """A planar walker stands, walks or runs."""

    speed = {"stand": 0.0, "walk": 1.0, "run": 8.0}  # m/s

    def __init__(self, scene: Scene, task: str) -> None:
        model = scene.model
        self.bodies = tuple(model.body(body).name for body in range(1, model.nbody))
        super().__init__(scene, task)

    def observation(self, qpos: Tensor, qvel: Tensor, extra: Tensor) -> Tensor:
        """X row of each body's rotation but for its y, torso's height, velocities."""
        motion = self.motion(qpos, qvel)
        row = motion.rotation[..., X, :]  # (*batch, n, 3)
        planar = torch.stack((row[..., X], row[..., Z]), -1).flatten(-2)
        return torch.cat((planar, motion.position[..., 0, Z:], qvel), -1)

    def reward(self, qpos: Tensor, qvel: Tensor, ctrl: Tensor, extra: Tensor) -> Tensor:
        """Torso high and upright, and the task's speed."""
        motion, wanted = self.motion(qpos, qvel), self.speed[self.task]
        standing = tolerance(motion.position[..., 0, Z], 1.2, inf, 0.6)
        upright = (1.0 + motion.rotation[..., 0, Z, Z]) / 2.0
        posture = (3.0 * standing + upright) / 4.0
        if wanted == 0.0:
            return posture
        moving = _moving(motion.com_velocity[..., X], wanted, wanted / 2.0, 0.5)
        return posture * (5.0 * moving + 1.0) / 6.0


def _moving(speed: Tensor, wanted: float, margin: float, at_margin: float) -> Tensor:
    """1 from the wanted speed (m/s) on, and linearly less below it."""
    return tolerance(speed, wanted, inf, margin, at_margin, "linear")


def _small(ctrl: Tensor) -> Tensor:
    """Mean over controls ``(*batch, nu)``: 1 without any, 0.8 from 1 on."""
    small = tolerance(ctrl, margin=1.0, at_margin=0.0, shape="quadratic")
    return (4.0 + small.mean(-1)) / 5.0


FORMULAS: dict[str, type[Formula]] = {
    kind.__name__.lower(): kind for kind in Formula.__subclasses__()
}
"""Domain -> its tasks' formulas."""
