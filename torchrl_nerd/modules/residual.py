"""A NeRD that corrects a cheap simulator step instead of replacing it.

The simulator knows that bodies do not sink into the ground; what is left to learn is small
and smooth, so that a few hundred recordings suffice. Its parameters are trained along.
"""

from collections.abc import Mapping

import torch
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_nerd.modules.correction import ResidualConfig
from torchrl_nerd.modules.nerd import TARGET, NeRD
from torchrl_nerd.modules.penalty_step import PenaltyStep
from torchrl_nerd.scenes.scene import Scene
from torchrl_nerd.transforms import Stats

HALF_GATE = 0.05  # m/s: pushes of that size are corrected by half of what the net says


class ResidualNeRD(NeRD):
    """The learned correction of a `PenaltyStep`; otherwise a `NeRD` like any other.

    The token ends with the change that the simulator predicts, normalised as targets are,
    and with how much of it is contact, 0 to 1: free flight needs no correction, and small
    ones would add up along a toss.

    Args:
        scene: a single free body on level ground.
        config: of the network and the simulator.
        stats: as for `NeRD`.
    """

    has_simulator = True

    def __init__(
        self,
        scene: Scene,
        config: ResidualConfig,
        stats: Mapping[NestedKey, Stats] | None = None,
    ) -> None:
        super().__init__(scene, config, stats)
        self.simulator = PenaltyStep(scene, config.substeps)

    def foresee(
        self,
        qpos: Tensor,
        qvel: Tensor,
        joint_torque: Tensor,
        terrain: Tensor | None = None,
    ) -> Tensor:
        """The simulator's change and how much of it is contact, ``(*batch, D + 1)``."""
        flat = qpos.reshape(-1, qpos.shape[-1]), qvel.reshape(-1, qvel.shape[-1])
        *after, push = self.simulator(*flat)
        after = (x.view_as(y) for x, y in zip(after, (qpos, qvel), strict=True))
        change = self.state_delta.delta(qpos, qvel, *after)
        change = self.normalize.normalize(TARGET, change)
        push = push.detach().view(*qpos.shape[:-1], 1)
        gate = push / (push + HALF_GATE)
        return torch.cat((change, gate), -1)

    def decode(
        self, qpos: Tensor, qvel: Tensor, output: Tensor
    ) -> tuple[Tensor, Tensor]:
        """As `NeRD.decode`, shapes and units too, but unbounded.

        The simulator knows what lies beyond the data.
        """
        delta = self.normalize.denormalize(TARGET, output.to(qpos.dtype))
        return self.state_delta.integrate(qpos, qvel, delta)
