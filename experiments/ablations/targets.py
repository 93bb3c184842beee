"""Other things to predict than `StateDelta`, each with its exact inverse."""

from collections.abc import Callable

import torch
from torch import Tensor

from torchrl_nerd.geometry.manifold import FREE
from torchrl_nerd.geometry.rotations import (
    quat_exp,
    quat_log,
    quat_normalize,
    rotate,
    rotate_inverse,
    wrap_angle,
)
from torchrl_nerd.scenes import Scene
from torchrl_nerd.transforms import RobotCentric, StateDelta

Limit = Callable[[Tensor, float], Tensor] | None


class PlainDelta(StateDelta):
    """s_{t+1} - s_t in B_t, the trapezoid rule left in, as in NeRD section 3.3."""

    def delta(
        self, qpos: Tensor, qvel: Tensor, next_qpos: Tensor, next_qvel: Tensor
    ) -> Tensor:
        """Change of velocity, then of position, ``(*batch, 2 nv)``."""
        found = super().delta(qpos, qvel, next_qpos, next_qvel)
        change, residual = found.chunk(2, -1)
        return torch.cat((change, residual + self.trapezoid(qpos, qvel, change)), -1)

    def integrate(
        self, qpos: Tensor, qvel: Tensor, delta: Tensor, limit: Limit = None
    ) -> tuple[Tensor, Tensor]:
        """Inverse of `delta`; see `StateDelta.integrate`."""
        change, moved = delta.chunk(2, -1)
        residual = moved - self.trapezoid(qpos, qvel, change)
        return super().integrate(qpos, qvel, torch.cat((change, residual), -1), limit)

    def error_weights(self, std: Tensor) -> Tensor:
        """All alike."""
        return torch.ones_like(std)

    def trapezoid(self, qpos: Tensor, qvel: Tensor, change: Tensor) -> Tensor:
        """What the rule moves a robot by whose velocity changes so, in B_t."""
        return self.step_size * (self.in_base(qpos, qvel) + 0.5 * change)

    def in_base(self, qpos: Tensor, qvel: Tensor) -> Tensor:
        """``qvel`` with the linear velocity of a floating base in B_t."""
        if not self.base.is_floating:
            return qvel
        return self._turn(qpos, qvel, rotate_inverse)


class AbsoluteState(PlainDelta):
    """s_{t+1} itself in B_t: where the base is by then, which is as before, all else whole.

    Velocities, positions, then sines and cosines of hinges without limits, whose angle
    as a number would jump by a turn.

    Args:
        scene: the robot.
    """

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene)
        model, angles = scene.model, RobotCentric(scene).joints.angles
        moving = [joint for joint in range(model.njnt) if model.jnt_type[joint] != FREE]
        pairs = [(int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j])) for j in moving]
        self.pairs = [pair for pair in pairs if pair[0] not in angles]
        self.turning = [pair for pair in pairs if pair[0] in angles]
        hinges = [v for _, v in self.turning]
        self.others = [v for v in range(model.nv) if v not in hinges]

    @property
    def size(self) -> int:
        """Width, one more for each hinge without limits."""
        return super().size + len(self.turning)

    def delta(
        self, qpos: Tensor, qvel: Tensor, next_qpos: Tensor, next_qvel: Tensor
    ) -> Tensor:
        """The next state ``(*batch, size)``."""
        found = super().delta(qpos, qvel, next_qpos, next_qvel)
        change, moved = found.chunk(2, -1)
        place = moved + self.joints(qpos)
        angle = place[..., [v for _, v in self.turning]]
        after = change + self.in_base(qpos, qvel)
        return torch.cat((after, place[..., self.others], angle.sin(), angle.cos()), -1)

    def integrate(
        self, qpos: Tensor, qvel: Tensor, delta: Tensor, limit: Limit = None
    ) -> tuple[Tensor, Tensor]:
        """Inverse of `delta`; see `StateDelta.integrate`."""
        nv, count = self.layout.nv, len(self.turning)
        sizes = (nv, nv - count, count, count)
        after, others, sine, cosine = delta.split(sizes, -1)
        place = torch.empty_like(after)
        place[..., self.others] = others
        hinges = [v for _, v in self.turning]
        place[..., hinges] = torch.atan2(sine, cosine)
        moved = place - self.joints(qpos)
        moved[..., hinges] = wrap_angle(moved[..., hinges])
        change = after - self.in_base(qpos, qvel)
        return super().integrate(qpos, qvel, torch.cat((change, moved), -1), limit)

    def joints(self, qpos: Tensor) -> Tensor:
        """Positions of the joints, ``(*batch, nv)``; zero for a floating base."""
        found = qpos.new_zeros(*qpos.shape[:-1], self.layout.nv)
        for q, v in (*self.pairs, *self.turning):
            found[..., v] = qpos[..., q]
        return found


class WorldDelta(StateDelta):
    """`StateDelta` with all that is of a floating base in world axes, as in NeRD eq. 1."""

    def delta(
        self, qpos: Tensor, qvel: Tensor, next_qpos: Tensor, next_qvel: Tensor
    ) -> Tensor:
        """Velocity change and trapezoid residual, ``(*batch, 2 nv)``."""
        found = super().delta(qpos, qvel, next_qpos, next_qvel)
        return self._aim(qpos, found, rotate)

    def integrate(
        self, qpos: Tensor, qvel: Tensor, delta: Tensor, limit: Limit = None
    ) -> tuple[Tensor, Tensor]:
        """Inverse of `delta`; see `StateDelta.integrate`."""
        found = self._aim(qpos, delta, rotate_inverse)
        return super().integrate(qpos, qvel, found, limit)

    def _aim(
        self, qpos: Tensor, x: Tensor, turn: Callable[[Tensor, Tensor], Tensor]
    ) -> Tensor:
        if not self.base.is_floating:
            return x
        q, v = self.base.qpos_address + 3, self.base.dof_address
        quat, found = qpos[..., q : q + 4], x.clone()
        for first in (v, v + 3, self.layout.nv + v, self.layout.nv + v + 3):
            found[..., first : first + 3] = turn(quat, x[..., first : first + 3])
        return found


class QuaternionDelta(PlainDelta):
    """`StateDelta`, but a floating base's turn as the paper's four numbers, in B_t.

    They come last, in place of the three that `StateDelta` leaves of it.
    """

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene)
        first = self.layout.nv + self.base.dof_address + 3
        self.turn = slice(first, first + 3)

    @property
    def size(self) -> int:
        """Width, one more."""
        return super().size + 1

    def delta(
        self, qpos: Tensor, qvel: Tensor, next_qpos: Tensor, next_qvel: Tensor
    ) -> Tensor:
        """Change of the state ``(*batch, 2 nv + 1)``."""
        plain = super().delta(qpos, qvel, next_qpos, next_qvel)
        rest = StateDelta.delta(self, qpos, qvel, next_qpos, next_qvel)
        before, after = rest[..., : self.turn.start], rest[..., self.turn.stop :]
        return torch.cat((before, after, quat_exp(plain[..., self.turn])), -1)

    def integrate(
        self, qpos: Tensor, qvel: Tensor, delta: Tensor, limit: Limit = None
    ) -> tuple[Tensor, Tensor]:
        """Inverse of `delta`; see `StateDelta.integrate`."""
        rest, quat = delta[..., :-4], quat_normalize(delta[..., -4:])
        change, nv = rest[..., : self.layout.nv], self.layout.nv
        gone = self.trapezoid(qpos, qvel, change)
        v = self.turn.start - nv
        turn = quat_log(quat) - gone[..., v : v + 3]
        parts = rest[..., : self.turn.start], turn, rest[..., self.turn.start :]
        return StateDelta.integrate(self, qpos, qvel, torch.cat(parts, -1), limit)
