"""A learned model with its own errors as noise.

A network trained on the mean of what may happen is smoother than the robot: it seldom falls
where the robot falls. Chua et al., 2018, https://arxiv.org/abs/1805.12114, let an ensemble
predict a distribution. Here the distribution is that of the model's errors of one step on
motion that it did not learn from.
"""

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_nerd.dynamics import NeRDDynamics
from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.modules.nerd import NeRD


@torch.no_grad()
def relative_errors(model: NeRD, data: TensorDictBase) -> Tensor:
    """Errors of qvel after one step, as shares of the length of its change, ``(n, nv)``.

    For models that keep no past. ``data`` hold states, torques and, of servos, ``ctrl``.
    """
    data = data.reshape(-1)
    state, dynamics = data.select(QPOS, QVEL), NeRDDynamics(model)
    drive = data["next", "joint_torque"], None, data.get(("next", "ctrl"), None)
    found, after = dynamics.step(state, *drive)[QVEL], data["next", QVEL]
    change = (after - data[QVEL]).square().sum(-1, keepdim=True).sqrt()
    errors = (after - found) / change
    return errors[errors.isfinite().all(-1)]


class NoisyDynamics(NeRDDynamics):
    """A model; each step adds a random one of ``errors``, times ``share``, to qvel.

    Args:
        model: keeps no past.
        errors: see `relative_errors`.
        share: of them that is added.
    """

    def __init__(self, model: NeRD, errors: Tensor, share: float) -> None:
        super().__init__(model)
        self.errors, self.share = errors, share

    def step(self, state: TensorDictBase, *given: Any, **how: Any) -> TensorDictBase:
        """See `Dynamics.step`."""
        after = super().step(state, *given, **how)
        drawn = torch.randint(
            len(self.errors), (len(after),), device=self.errors.device
        )
        change = (after[QVEL] - state[QVEL]).square().sum(-1, keepdim=True).sqrt()
        error = self.share * change * self.errors[drawn].to(change)  # (num_envs, nv)
        return after.set(QVEL, after[QVEL] + error)
