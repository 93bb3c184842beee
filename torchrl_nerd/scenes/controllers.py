"""What turns an action into joint torque: everything a learned solver never sees.

A controller is a function of the action and the state; a new one needs no new model.
"""

from collections.abc import Callable

import torch
from torch import Tensor

Controller = Callable[[Tensor, Tensor, Tensor], Tensor]
"""``(action (*batch, A), qpos, qvel) -> joint_torque (*batch, num_actuated)``, float64."""


class TorqueController:
    """Torque proportional to the action: ``gain * clip(action, -1, 1)``.

    Args:
        gain: N or N m per unit of action, one per actuated dof.
    """

    def __init__(self, gain: tuple[float, ...]) -> None:
        self.gain = gain
        self.num_actions = len(gain)

    def __call__(self, action: Tensor, qpos: Tensor, qvel: Tensor) -> Tensor:
        """Joint torques ``(*batch, num_actuated)`` in the dtype of ``qpos``."""
        gain = torch.tensor(self.gain, dtype=qpos.dtype, device=qpos.device)
        return action.to(qpos.dtype).clamp(-1.0, 1.0) * gain
