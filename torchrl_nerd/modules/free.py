"""A NeRD of a robot that nothing touches: its free motion's step, and what that leaves.

Most of what a solver does then needs no learning: it is the equation of motion. A network
errs by a tenth of a step where two looks at that equation err by a thousandth, see
docs/studies.md. So it is left with the rest, joints' limits above all, and has no more say
than there is to say.
"""

from collections.abc import Mapping

import torch
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_nerd.modules.correction import FreeConfig
from torchrl_nerd.modules.free_step import FreeStep, expect_none, untold_pushes
from torchrl_nerd.modules.nerd import TARGET, NeRD
from torchrl_nerd.scenes.scene import Scene
from torchrl_nerd.transforms import Stats

HALF_GATE = 1e-3  # rad or m: half of what the network says counts so far beyond a limit


class FreeNeRD(NeRD):
    """A `FreeStep` and its learned correction; otherwise a `NeRD` like any other.

    The token ends with the change that the step foresees, normalised as targets are, and
    with its doubt, 0 to 1: the root mean square of what the second look changed, and
    how far the step begins or ends beyond a limit. Of what the network says, and so of its
    error, that share goes into the change.

    Args:
        scene: of a fixed robot without a ground that `FreeStep` can move.
        config: of the network.
        stats: as for `NeRD`.

    Raises:
        ValueError: another robot.
    """

    has_simulator = True
    has_short_loops = True

    def __init__(
        self,
        scene: Scene,
        config: FreeConfig,
        stats: Mapping[NestedKey, Stats] | None = None,
    ) -> None:
        touched = {"a floating base": scene.base.is_floating}
        touched["a ground"] = scene.terrain is not None
        expect_none(scene, touched | untold_pushes(scene))
        super().__init__(scene, config, stats)
        self.free_step = FreeStep(scene)

    def foresee(
        self,
        qpos: Tensor,
        qvel: Tensor,
        joint_torque: Tensor,
        terrain: Tensor | None = None,
    ) -> Tensor:
        """The step's change and its doubt, ``(*batch, D + 1)``."""
        *after, second, beyond = self.free_step(qpos, qvel, joint_torque)
        change = self.state_delta.delta(qpos, qvel, *after)
        second = second / self.normalize.std(TARGET)[: second.shape[-1]]
        doubt = second.square().mean(-1, keepdim=True).sqrt()
        doubt = (doubt + beyond / (beyond + HALF_GATE)).clamp_max(1.0)
        return torch.cat((self.normalize.normalize(TARGET, change), doubt), -1)
