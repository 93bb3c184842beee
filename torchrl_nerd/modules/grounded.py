"""A NeRD of a robot on the ground: a step along its springs, and what that leaves.

The ground and the limits of the paper's robots are explicit springs, and between two looks
at a robot little changes but what they push with. A network that has to find all that out
errs by a tenth of a step, `GroundStep` by a hundredth. So the network is left with the
rest, and has the more say the more wrong the last looks' velocities were.
"""

from collections.abc import Mapping

import torch
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_nerd.modules.correction import GroundedConfig
from torchrl_nerd.modules.ground_step import GroundStep
from torchrl_nerd.modules.nerd import TARGET, NeRD
from torchrl_nerd.scenes.scene import Scene
from torchrl_nerd.transforms import Stats


class GroundedNeRD(NeRD):
    """A `GroundStep` and its learned correction; otherwise a `NeRD` like any other.

    After the features the token holds by how much the velocities at the last look of every
    part were wrong, then the change of the state that the step foresees, normalised as
    targets are, and its doubt, 0 to 1: the root mean square of what was wrong.

    Args:
        scene: of a robot that `GroundStep` can move.
        config: of the network.
        stats: as for `NeRD`.

    Raises:
        ValueError: another robot.
    """

    config: GroundedConfig
    has_simulator = True
    has_short_loops = True

    def __init__(
        self,
        scene: Scene,
        config: GroundedConfig,
        stats: Mapping[NestedKey, Stats] | None = None,
    ) -> None:
        # refuses before anything is built
        step = GroundStep(scene, config.looks, config.stride, config.parts)
        super().__init__(scene, config, stats)
        self.ground_step = step

    @property
    def num_hints(self) -> int:
        """What was wrong at the last looks."""
        return self.config.parts * self.scene.layout.nv

    def foresee(
        self,
        qpos: Tensor,
        qvel: Tensor,
        joint_torque: Tensor,
        terrain: Tensor | None = None,
    ) -> Tensor:
        """What was wrong at last looks, the step's change, its doubt, ``(rows, K)``."""
        exact = torch.promote_types(self.dtype, torch.float32)
        *after, wrong = self.ground_step(qpos, qvel, joint_torque, terrain, exact)
        change = self.state_delta.delta(qpos, qvel, *after)
        change = self.normalize.normalize(TARGET, change)
        scale = self.normalize.std(TARGET)[: self.scene.layout.nv]
        wrong = wrong / scale.repeat(self.config.parts)
        doubt = wrong.square().mean(-1, keepdim=True).sqrt().clamp_max(1.0)
        return torch.cat((wrong, change, doubt), -1)
