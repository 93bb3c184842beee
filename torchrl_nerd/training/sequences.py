"""Training data on the device: tokens and targets once, batches by one gather."""

from typing import cast

import torch
from tensordict import TensorDict
from tensordict.utils import NestedKey
from torch import Generator, Tensor

from torchrl_nerd.keys import JOINT_TORQUE, NEXT_QPOS, NEXT_QVEL, QPOS, QVEL, TERRAIN
from torchrl_nerd.modules.nerd import TARGET, TOKEN, NeRD, SceneTokens
from torchrl_nerd.scenes import Scene
from torchrl_nerd.transforms import StateDelta, Stats

PART = 1024  # trajectories turned into tokens at a time


class Sequences:
    """Batches of sequences from a data set.

    Args:
        model: its features and statistics.
        data: ``[trajectories, steps]``.
        device: where batches are wanted.
    """

    def __init__(self, model: NeRD, data: TensorDict, device: torch.device) -> None:
        tokens, targets = [], []
        for part in data.split(PART):
            token, target = raw_tokens(model.tokens, model.state_delta, part)
            tokens.append(model.normalize.normalize(TOKEN, token).float())
            targets.append(model.normalize.normalize(TARGET, target).float())
        self.tokens, self.targets = (torch.cat(x).to(device) for x in (tokens, targets))
        self.data = data.to(device)
        self.steps = data.batch_size[1]

    def pick(
        self, rows: int, length: int, generator: Generator
    ) -> tuple[Tensor, Tensor]:
        """Random trajectories and times: indices ``(rows, 1), (rows, length)``."""
        device = self.tokens.device
        row = torch.randint(len(self.tokens), (rows, 1), generator=generator)
        last = self.steps - length + 1
        start = torch.randint(last, (rows, 1), generator=generator)
        return row.to(device), (start + torch.arange(length)).to(device)

    def one_step(
        self, rows: int, length: int, generator: Generator
    ) -> tuple[Tensor, Tensor]:
        """Tokens and targets ``(rows, length, D)``."""
        row, time_index = self.pick(rows, length, generator)
        return self.tokens[row, time_index], self.targets[row, time_index]

    def rollout(
        self, rows: int, length: int, generator: Generator
    ) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
        """True states ``(rows, length + 1, ...)``, torques and ground."""
        row, time_index = self.pick(rows, length, generator)
        batch = cast(TensorDict, self.data[row, time_index])
        qpos = torch.cat((batch[QPOS], batch[NEXT_QPOS][:, -1:]), 1)
        qvel = torch.cat((batch[QVEL], batch[NEXT_QVEL][:, -1:]), 1)
        terrain = batch.get(TERRAIN, None)
        ground = None if terrain is None else terrain[:, 0]
        return qpos, qvel, batch[JOINT_TORQUE], ground


def raw_tokens(
    tokens: SceneTokens, state_delta: StateDelta, data: TensorDict
) -> tuple[Tensor, Tensor]:
    """Unnormalised tokens and targets of transitions, float64."""
    terrain = data.get(TERRAIN, None)
    token = tokens(data[QPOS], data[QVEL], data[JOINT_TORQUE], terrain)
    target = state_delta.delta(data[QPOS], data[QVEL], data[NEXT_QPOS], data[NEXT_QVEL])
    return token, target


def data_stats(scene: Scene, data: TensorDict) -> dict[NestedKey, Stats]:
    """Exact statistics of tokens and targets over a data set."""
    tokens, state_delta = SceneTokens(scene), StateDelta(scene)
    parts = [raw_tokens(tokens, state_delta, part) for part in data.split(PART)]
    stats: dict[NestedKey, Stats] = {}
    for index, key in enumerate((TOKEN, TARGET)):
        merged, *rest = (Stats.of(part[index]) for part in parts)
        for other in rest:
            merged = merged.merge(other)
        stats[key] = merged
    return stats
