"""Many substeps between two looks at a robot: springs anew in each, all else on a line.

Springs and dampers are followed in all of MuJoCo's substeps, with points whose levers and
free accelerations change along the line through both looks, and the mass matrix of the
second one. See `GroundStep`.
"""

from math import ceil
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from torchrl_nerd.geometry.constants import keep_constants
from torchrl_nerd.geometry.elimination import times
from torchrl_nerd.geometry.joint_axes import JointAxes
from torchrl_nerd.geometry.kinematics import cross
from torchrl_nerd.modules.look import Look, LookAt
from torchrl_nerd.modules.springs import ContactSprings, LimitSprings
from torchrl_nerd.scenes.scene import Scene


class Reached(NamedTuple):
    """Where substeps have come to; rows last."""

    speed: Tensor  # (nv, N)
    moved: Tensor  # (nv, N), a tangent

    def to(self, other: "Reached", share: float) -> "Reached":
        """A share of the way to another one."""
        pairs = zip(self, other, strict=True)
        return Reached(*(torch.lerp(one, end, share) for one, end in pairs))


class March(nn.Module):
    """Substeps of a robot at the springs of its ground and limits.

    Args:
        scene: whose contacts and limits are springs and dampers, see `scenes.penalty_law`.
        axes: its joints.
        look_at: what looked at it.
        step_size: s, of a substep.
        at: when in a substep it is pushed, of its whole: 0.5 makes it a leapfrog.

    Raises:
        ValueError: contacts or limits of another law.
    """

    limited: Tensor
    limited_places: Tensor
    reaches: Tensor

    def __init__(
        self,
        scene: Scene,
        axes: JointAxes,
        look_at: LookAt,
        step_size: float,
        at: float,
    ) -> None:
        super().__init__()
        self.step_size, self.at = step_size, at
        self.look_at, self.whole = look_at, look_at.whole
        self.contact = ContactSprings(scene)
        self.limit = LimitSprings(scene.model, axes)
        limited = [2 * self.whole + joint for joint in self.limit.joints]
        pushed = [*look_at.rates.tolist(), *limited]
        reaches = np.zeros((scene.model.nv, len(pushed)))
        reaches[np.array(pushed, int), range(len(pushed))] = 1.0
        addresses = look_at.motion.qpos_addresses
        places = [addresses[joint] for joint in self.limit.joints]
        for name, numbers in (("limited", limited), ("limited_places", places)):
            index = torch.from_numpy(np.array(numbers, dtype=np.int64))
            self.register_buffer(name, index, persistent=False)
        keep_constants(self, reaches=reaches)

    def forward(
        self,
        start: Look,
        look: Look,
        since: float,
        qpos: Tensor,
        qvel: Tensor,
        until: float,
    ) -> list[Reached]:
        """Where substeps lead to, one by one, from nowhere on.

        Args:
            start: the first look, whence levers and free accelerations change
            look: to the last one, in whose axes the march is, with whose mass matrix.
            since: time between both, in substeps; 0: they are one, and nothing changes.
            qpos: at the start, ``(N, nq)``.
            qvel: at the start, ``(N, nv)``.
            until: a time in substeps to be reached.
        """
        step, levers, normal, depth, free, inverse, _ = self.step_size, *look
        joints = qpos.mT[self.limited_places].to(free)
        speed = self.turned(qvel.mT, look.rotation.mT).to(free)
        bend, drift = None, None
        if since:
            turn = look.rotation.mT @ start.rotation
            levers, normal = (_rotated(x, turn) for x in (start.levers, start.normal))
            free, depth = self.turned(start.free, turn), start.depth
            share = 1.0 / since  # of the way to it, each substep
            bend, drift = share * (look.levers - levers), share * (look.free - free)
        first, moved = levers, torch.zeros_like(speed)
        change = moved
        marches, reaches = [Reached(speed, moved)], self.reaches.to(speed)
        for number in range(ceil(until)):
            time = number + self.at
            if bend is not None:
                levers = torch.add(first, bend, alpha=time)
            velocity = self.look_at.velocity(levers, speed)
            rising = (velocity * normal).sum(0)
            if time:
                depth = depth - min(1.0, time) * step * rising
            damped = speed
            if self.at:
                moved = self._composed(moved, self.at * step * speed)
                damped = speed + self.at * change  # halfway, if pushed as just before
                velocity = self.look_at.velocity(levers, damped)
                rising = (velocity * normal).sum(0)
            sliding = velocity - rising * normal
            force = self.contact(depth, rising, sliding, normal)
            at = joints + moved[self.limited], damped[self.limited]
            pushes = (levers * force[:, :, None]).sum(0).flatten(0, 1), self.limit(*at)
            push = times(reaches, torch.cat(pushes))
            if self.whole:
                push = torch.cat((force.sum(1), push[self.whole :]))
            gain = free if drift is None else torch.add(free, drift, alpha=time)
            change = step * (gain + (inverse * push).sum(1))
            speed = speed + change
            moved = self._composed(moved, (1.0 - self.at) * step * speed)
            marches.append(Reached(speed, moved))
        return marches

    def turned(self, rates: Tensor, rotation: Tensor) -> Tensor:
        """``rates (nv, N)`` with the base's velocity in other axes."""
        if not self.whole:
            return rates
        return torch.cat((_rotated(rates[:3], rotation), rates[3:]))

    def _composed(self, moved: Tensor, further: Tensor) -> Tensor:
        """The tangent of two motions, one after the other, to second order."""
        total = moved + further
        if not self.whole:
            return total
        turns = slice(self.whole, 2 * self.whole)
        twist = 0.5 * cross(moved[turns], further[turns])
        return torch.cat((total[: self.whole], total[turns] + twist, total[6:]))


def reached(marches: list[Reached], time: float) -> Reached:
    """Where substeps were at a time, in substeps."""
    before = int(time)
    if before == time:
        return marches[before]
    return marches[before].to(marches[before + 1], time - before)


def _rotated(vectors: Tensor, rotation: Tensor) -> Tensor:
    """``rotation (N, 3, 3)`` applied to ``vectors (3, *size, N)``."""
    rotation = rotation.permute(1, 2, 0).to(vectors)
    rotation = rotation.reshape(3, 3, *[1] * (vectors.ndim - 2), -1)
    return (rotation * vectors).sum(1)
