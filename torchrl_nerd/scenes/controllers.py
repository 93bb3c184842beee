"""What turns an action into joint torque: everything a learned solver never sees.

A controller is a function of the action and the state; a new one needs no new model.
"""

from dataclasses import dataclass
from typing import Literal, Protocol

import torch
from torch import Tensor


class Controller(Protocol):
    """``(action (*batch, num_actions), qpos, qvel) -> joint torque``, float64."""

    @property
    def num_actions(self) -> int:
        """Width of the action."""
        ...

    def __call__(self, action: Tensor, qpos: Tensor, qvel: Tensor) -> Tensor:
        """Joint torques ``(*batch, num_actuated)``, N and N m, in the dtype of qpos."""
        ...


@dataclass(frozen=True)
class TorqueController:
    """Torque proportional to the action: ``gain * clip(action, -1, 1)``.

    Args:
        gain: N or N m per unit of action, one per actuated dof.
    """

    gain: tuple[float, ...]

    @property
    def num_actions(self) -> int:
        """One per actuated dof."""
        return len(self.gain)

    def __call__(self, action: Tensor, qpos: Tensor, qvel: Tensor) -> Tensor:
        """Joint torques ``(*batch, num_actuated)``."""
        return action.to(qpos.dtype).clamp(-1.0, 1.0) * qpos.new_tensor(self.gain)


@dataclass(frozen=True)
class PDController:
    """A spring and damper to a target: ``clip(kp (target - q) - kd v, -limit, limit)``.

    The target is ``scale * clip(action, -1, 1)`` added to zero (``absolute``), to
    ``default`` or to the present position (``current``).

    Args:
        qpos_addresses: of the actuated joints.
        dof_addresses: of the same joints.
        kp: stiffness, N m/rad or N/m, one per joint.
        kd: damping, N m s/rad or N s/m.
        scale: rad or m per unit of action.
        relative_to: what the target is relative to.
        default: pose of the actuated joints; needed for ``relative_to="default"``.
        limit: largest torque; None for none.

    Raises:
        ValueError: lengths that differ, or no default where one is needed.
    """

    qpos_addresses: tuple[int, ...]
    dof_addresses: tuple[int, ...]
    kp: tuple[float, ...]
    kd: tuple[float, ...]
    scale: tuple[float, ...]
    relative_to: Literal["absolute", "default", "current"] = "absolute"
    default: tuple[float, ...] | None = None
    limit: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        if self.relative_to == "default" and self.default is None:
            raise ValueError("expected a default pose to be relative to, got none")
        for name in ("dof_addresses", "kp", "kd", "scale", "default", "limit"):
            value = getattr(self, name)
            if value is not None and len(value) != self.num_actions:
                raise ValueError(
                    f"expected {self.num_actions} numbers as {name}, got {len(value)}"
                )

    @property
    def num_actions(self) -> int:
        """One per actuated joint."""
        return len(self.qpos_addresses)

    def __call__(self, action: Tensor, qpos: Tensor, qvel: Tensor) -> Tensor:
        """Joint torques ``(*batch, num_actuated)``."""
        position = qpos[..., self.qpos_addresses]
        target = action.to(qpos.dtype).clamp(-1.0, 1.0) * qpos.new_tensor(self.scale)
        if self.relative_to == "current":
            target = target + position
        elif self.relative_to == "default":
            target = target + qpos.new_tensor(self.default)
        return self.torque(target, qpos, qvel)

    def torque(self, target: Tensor, qpos: Tensor, qvel: Tensor) -> Tensor:
        """Joint torques that pull to ``target (*batch, num_actuated)``."""
        offset = target - qpos[..., self.qpos_addresses]
        velocity = qvel[..., self.dof_addresses]
        torque = qpos.new_tensor(self.kp) * offset - qpos.new_tensor(self.kd) * velocity
        if self.limit is None:
            return torque
        limit = qpos.new_tensor(self.limit)
        return torch.minimum(torch.maximum(torque, -limit), limit)
