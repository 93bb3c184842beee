"""Error of a model's own rollout against measured poses: nothing else need be known."""

from typing import cast

import torch
from torch import Tensor

from torchrl_nerd.geometry.rotations import quat_conjugate, quat_multiply
from torchrl_nerd.modules.nerd import NeRD, Network

POSITION_SCALE = 0.05  # m that weigh as much as ...
ORIENTATION_SCALE = 1.0  # rad; the best errors have this ratio
SMOOTH = 1e-5  # m and rad below which lengths count no more


def rollout(model: NeRD, qpos: Tensor, qvel: Tensor, steps: int) -> Tensor:
    """Positions after each passive step, ``(rows, steps, nq)``, with gradients.

    Args:
        model: of a robot without motors on the scene's own ground.
        qpos: start ``(rows, nq)``, float64.
        qvel: ``(rows, nv)``.
        steps: how many.
    """
    network = cast(Network, model.network)
    memory, idle = network.empty_memory(len(qpos)), qpos[:, :0]
    path = []
    for _ in range(steps):
        qpos, qvel, _ = model.step(
            (qpos, qvel), idle, None, lambda token: network.step(token, memory)
        )
        path.append(qpos)
    return torch.stack(path, 1)


def pose_error(path: Tensor, measured: Tensor) -> Tensor:
    """Distance plus angle, each by its scale, ``(*batch,)``; smooth where both vanish.

    Not squared: after a first impact that was missed all that follows is far off, and must
    not outweigh the impacts that can be learned.

    Args:
        path: positions of a free body ``(*batch, 7)``.
        measured: the same, as recorded.
    """
    gap = (path[..., :3] - measured[..., :3]).square().sum(-1)
    turn = quat_multiply(quat_conjugate(measured[..., 3:7]), path[..., 3:7])
    sine = turn[..., 1:].square().sum(-1)
    angle = 2.0 * torch.atan2((sine + SMOOTH**2).sqrt(), turn[..., 0].abs())
    return (gap + SMOOTH**2).sqrt() / POSITION_SCALE + angle / ORIENTATION_SCALE


def pose_loss(path: Tensor, measured: Tensor, seen: Tensor | None = None) -> Tensor:
    """Mean `pose_error` over what was seen.

    Args:
        path: ``(rows, steps, 7)``.
        measured: the same, as recorded.
        seen: bool ``(steps,)``, the frames that were recorded; all where None.
    """
    error = pose_error(path, measured)
    return (error if seen is None else error[:, seen]).mean()
