"""Sleep: a robot at rest stays exactly where it is.

As in game and robot engines: no solver's rest is exact, and a learned one's noise would
carry a resting robot away in time.
"""

import torch
from torch import Tensor, nn

from torchrl_nerd.modules.training_range import magnitudes, vector_dofs
from torchrl_nerd.scenes.scene import Scene


class Sleep(nn.Module):
    """Thresholds below which a robot over a ground is put to sleep; zero until set.

    | buffer | meaning |
    |---|---|
    | ``sleep_speed`` | ``(nv,)``, m/s and rad/s: speed of the model's noise at rest |
    | ``sleep_gain`` | ``(nv,)``: speed that the model adds to a resting robot in a step;
      one that gains more begins to move, as on a slope that friction does not hold |

    Args:
        scene: the robot; without a ground it never sleeps.
    """

    sleep_speed: Tensor
    sleep_gain: Tensor

    def __init__(self, scene: Scene) -> None:
        super().__init__()
        self.vectors, self.can_rest = vector_dofs(scene), scene.terrain is not None
        zero = torch.zeros(scene.model.nv, dtype=torch.float64)
        self.register_buffer("sleep_speed", zero)
        self.register_buffer("sleep_gain", zero.clone())

    def apply_sleep(
        self, before: tuple[Tensor, Tensor], after: tuple[Tensor, Tensor]
    ) -> tuple[Tensor, Tensor]:
        """The state after, or the one before at zero velocity where the robot sleeps.

        Args:
            before: ``qpos (*batch, nq)`` and ``qvel (*batch, nv)``.
            after: the same, one step later.
        """
        if not self.can_rest:
            return after
        old, new = (magnitudes(self.vectors, state[1]) for state in (before, after))
        is_slow = torch.maximum(old, new) < self.sleep_speed
        is_asleep = (is_slow & (new - old < self.sleep_gain)).all(-1, keepdim=True)
        qpos = torch.where(is_asleep, before[0], after[0])
        return qpos, after[1].masked_fill(is_asleep, 0.0)
