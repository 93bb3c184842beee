"""Rows that neither ground nor limits push for a whole step move along their free motion.

There the equation of motion is all there is, two looks at it err by a millionth where a
network errs by a tenth, and whatever a robot has gone astray by when it lands its contacts
make more of. So the network is left with contact.
"""

import torch
from torch import Tensor, nn

from torchrl_nerd.compiled import uncompiled
from torchrl_nerd.modules.free_step import FreeStep
from torchrl_nerd.scenes.scene import Scene

LEAST_GAP = 1e-3  # m: a point may come nearer within the step than at both its ends
BLOCK = 16  # rows: products of so many give each the same bits, whichever they are

State = tuple[Tensor, Tensor]


class Flight(nn.Module):
    """Puts the free motion's next state in the place of the network's, row by row.

    A row flies where no contact point is near the ground and no joint near a limit, when
    the step begins and when it ends.

    Args:
        scene: of a robot that `FreeStep` can move, with a ground.

    Raises:
        ValueError: another robot, or one without a ground.
    """

    def __init__(self, scene: Scene) -> None:
        super().__init__()
        if scene.terrain is None:
            raise ValueError(f"expected a ground to fly over, got scene '{scene.name}'")
        self.scene, self.free_step = scene, FreeStep(scene)

    def forward(
        self,
        before: State,
        joint_torque: Tensor,
        terrain: Tensor | None,
        gap: Tensor,
        after: State,
    ) -> State:
        """The next state, of rows that fly by the free motion, of others as it was.

        On a processor only rows that may fly are looked at; on a GPU, which would have to
        wait for their number, all are.

        Args:
            before: ``qpos (rows, nq)`` and ``qvel (rows, nv)``.
            joint_torque: ``(rows, num_actuated)``.
            terrain: ``(rows, terrain.size)``; None for the scene's own ground.
            gap: between every contact point and the ground, ``(rows, P)``, m.
            after: the next ``qpos`` and ``qvel`` as the network tells them.
        """
        may_fly = (gap > LEAST_GAP).all(-1) & self.free_step.is_within(before[0])
        if gap.device.type != "cpu":
            return self.fly_at_once(before, joint_torque, terrain, may_fly, after)
        rows = _numbers(may_fly)
        if not len(rows):
            return after
        ground = None if terrain is None else terrain[rows]
        start = before[0][rows], before[1][rows]
        found, flies = self._fly(start, joint_torque[rows], ground)
        return tuple(  # pyright: ignore
            old.index_put((rows,), torch.where(flies[:, None], new, old[rows]))
            for new, old in zip(found, after, strict=True)
        )

    def fly_at_once(
        self,
        before: State,
        joint_torque: Tensor,
        terrain: Tensor | None,
        may_fly: Tensor,
        after: State,
    ) -> State:
        """As `forward`, of rows that ``may_fly (rows,)``, with shapes that stay."""
        found, flies = self._fly(before, joint_torque, terrain)
        flies = (flies & may_fly)[:, None]
        return tuple(  # pyright: ignore
            torch.where(flies, new, old) for new, old in zip(found, after, strict=True)
        )

    def _fly(
        self, before: State, joint_torque: Tensor, terrain: Tensor | None
    ) -> tuple[State, Tensor]:
        """Next states along the free motion, and whether nothing is met ``(rows,)``."""
        qpos, qvel, _, beyond = self.free_step(*before, joint_torque)
        is_clear = (self.scene.clearances(qpos, terrain) > LEAST_GAP).all(-1)
        return (qpos, qvel), is_clear & (beyond == 0.0)[..., 0]


@uncompiled
def _numbers(rows: Tensor) -> Tensor:
    """Which rows of a mask; the last one once more and again, to make whole blocks."""
    (found,) = rows.nonzero(as_tuple=True)
    found = torch.cat((found, found[-1:].expand(-len(found) % BLOCK)))
    torch._dynamo.maybe_mark_dynamic(found, 0)  # compiled once for any number of blocks
    return found
