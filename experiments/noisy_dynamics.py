"""A learned model with its own errors as noise.

A network trained on the mean of what may happen is smoother than the robot: it seldom falls
where the robot falls. Chua et al., 2018, https://arxiv.org/abs/1805.12114, let an ensemble
predict a distribution. Here the distribution is that of the model's errors of one step on
motion that it did not learn from.
"""

from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_nerd.dynamics import NeRDDynamics
from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.modules.nerd import NeRD

STILL = 0.1  # changes shorter than this share of their rms count as that long


class StepErrors(NamedTuple):
    """Errors of qvel after one step, and what they are shares of."""

    shares: Tensor  # (n, nv), of the length of the change of qvel
    least: Tensor  # (), the shortest length that counts: of a robot nearly at rest


def _length(change: Tensor, least: Tensor) -> Tensor:
    """Of changes ``(n, nv)``, at least ``least``; ``(n, 1)``."""
    length = torch.linalg.vector_norm(change, dim=-1, keepdim=True)
    return length.clamp(min=least.to(change))


@torch.no_grad()
def step_errors(model: NeRD, data: TensorDictBase) -> StepErrors:
    """Errors of one step on ``data``: states, torques and, of servos, ``ctrl``.

    For models that keep no past.
    """
    data = data.reshape(-1)
    state, dynamics = data.select(QPOS, QVEL), NeRDDynamics(model)
    drive = data["next", "joint_torque"], None, data.get(("next", "ctrl"), None)
    found, after = dynamics.step(state, *drive)[QVEL], data["next", QVEL]
    change = after - data[QVEL]
    least = STILL * change.square().sum(-1).mean().sqrt()
    errors = (after - found) / _length(change, least)
    return StepErrors(errors[errors.isfinite().all(-1)], least)


class NoisyDynamics(NeRDDynamics):
    """A model; each step adds a random one of ``errors``, times ``share``, to qvel.

    Args:
        model: keeps no past.
        errors: see `step_errors`.
        share: of them that is added.
    """

    def __init__(self, model: NeRD, errors: StepErrors, share: float) -> None:
        super().__init__(model)
        self.errors, self.share = errors, share

    def step(self, state: TensorDictBase, *given: Any, **how: Any) -> TensorDictBase:
        """See `Dynamics.step`."""
        after, (shares, least) = super().step(state, *given, **how), self.errors
        drawn = torch.randint(len(shares), (len(after),), device=shares.device)
        length = _length(after[QVEL] - state[QVEL], least)
        error = self.share * length * shares[drawn].to(length)  # (num_envs, nv)
        return after.set(QVEL, after[QVEL] + error)
