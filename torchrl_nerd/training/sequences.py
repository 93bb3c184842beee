"""Training data on the device: tokens and targets once, batches by one gather."""

from collections.abc import Callable
from typing import NamedTuple, cast

import torch
from tensordict import TensorDict
from torch import Generator, Tensor

from torchrl_nerd.keys import (
    JOINT_TORQUE,
    NEXT_QPOS,
    NEXT_QVEL,
    PARAMETERS,
    QPOS,
    QVEL,
    TERRAIN,
)
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.scenes.commands import command_of
from torchrl_nerd.training.samples import normalised
from torchrl_nerd.training.symmetry import Symmetry

FEW = 32  # trajectories that an analytic step takes at a time: fits the cache


class Inputs(NamedTuple):
    """What the network of a model is given, and what its output is added to."""

    token: Tensor  # (*batch, token_size), float32
    base: Tensor  # (*batch, D): the analytic change of a hybrid; (): zero
    gate: Tensor  # (*batch, 1) of a hybrid; (): one

    @classmethod
    @torch.no_grad()
    def of(cls, model: NeRD, data: TensorDict, features: Tensor) -> "Inputs":
        """Those of a whole data set, unclamped; a learned model's are its features."""
        if model.kind == "learned":
            return cls(features, features.new_zeros(()), features.new_ones(()))
        parts = []
        for part in data.split(FEW):
            state, terrain = (part[QPOS], part[QVEL]), part.get(TERRAIN, None)
            found = model.encode(*state, part[JOINT_TORQUE], terrain)
            parts.append([torch.as_tensor(x).float() for x in found[1:]])
        return cls(*(torch.cat(x) for x in zip(*parts, strict=True)))

    def each(self, function: Callable[[Tensor], Tensor]) -> "Inputs":
        """The result of a function for every part that has samples."""
        return Inputs(*(function(x) if x.ndim else x for x in self))

    def change(self, output: Tensor) -> Tensor:
        """The normalised change ``(*batch, D)`` that a network's output makes."""
        return self.base + self.gate * output


class Sequences:
    """Batches of sequences from a data set ``[trajectories, steps]``, on its device.

    With ``symmetry`` each sample of a learned model is shown as a random one of its images.
    """

    def __init__(
        self, model: NeRD, data: TensorDict, symmetry: Symmetry | None = None
    ) -> None:
        self.features, self.targets = normalised(model, data)
        self.inputs, self.data = Inputs.of(model, data, self.features), data
        self.symmetry = symmetry.to(self.targets.device) if symmetry else None
        self.scene, self.steps = model.scene, data.batch_size[1]
        self.change = change_times(data)

    def pick(
        self, rows: int, length: int, generator: Generator
    ) -> tuple[Tensor, Tensor]:
        """Random trajectories and times: indices ``(rows, 1), (rows, length)``."""
        row = torch.randint(len(self.targets), (rows, 1), generator=generator)
        last = self.steps - length + 1
        start = torch.randint(last, (rows, 1), generator=generator)
        row, start = self._sent(row), self._sent(start)
        return row, start + torch.arange(length, device=start.device)

    def _sent(self, drawn: Tensor) -> Tensor:
        """Random numbers of the host on the device, which it does not wait for."""
        return drawn.to(self.targets.device, non_blocking=True)

    def one_step(
        self, rows: int, length: int, generator: Generator
    ) -> tuple["Inputs", Tensor]:
        """Network inputs and targets of ``(rows, length)`` samples."""
        row, time_index = self.pick(rows, length, generator)
        targets = self.targets[row, time_index]  # (rows, length, D)
        inputs = self.inputs.each(lambda x: x[row, time_index])
        if self.symmetry is None:
            return inputs, targets
        count = len(self.symmetry.isometries)
        choice = self._sent(torch.randint(count, (rows,), generator=generator))
        token = self.symmetry.tokens(inputs.token, choice)
        return inputs._replace(token=token), self.symmetry.targets(targets, choice)

    def _of_one_robot(self, row: Tensor, time_index: Tensor) -> Tensor:
        """Windows ``(rows, length)`` moved behind their robot's change, or before it."""
        assert self.change is not None
        change, first, length = self.change[row], time_index[:, :1], time_index.shape[1]
        is_mixed = (first < change) & (change < first + length)  # (rows, 1)
        is_early = change + length > self.steps
        moved = torch.where(is_early, (change - length).clamp_min(0), change)
        return time_index - first + torch.where(is_mixed, moved, first)

    def rollout(
        self, rows: int, length: int, generator: Generator
    ) -> tuple[Tensor, Tensor, Tensor, Tensor | None, Tensor | None]:
        """True ``qpos``, ``qvel (rows, length + 1, ...)``, commands, ground, parameters."""
        row, time_index = self.pick(rows, length, generator)
        if self.change is not None:
            time_index = self._of_one_robot(row, time_index)
        batch = cast(TensorDict, self.data[row, time_index])
        if self.symmetry is not None:  # the rows are in no order: a part for each
            isometries = self.symmetry.isometries
            parts = zip(isometries, batch.chunk(len(isometries)), strict=False)
            images = [isometry(part) for isometry, part in parts]
            batch = cast(TensorDict, torch.cat(images))  # pyright: ignore
        qpos = torch.cat((batch[QPOS], batch[NEXT_QPOS][:, -1:]), 1)
        qvel = torch.cat((batch[QVEL], batch[NEXT_QVEL][:, -1:]), 1)
        first = cast(TensorDict, batch[:, 0])  # these are the same at all times
        own = first.get(TERRAIN, None), first.get(PARAMETERS, None)  # (rows, size)
        return qpos, qvel, command_of(self.scene, batch), *own


def change_times(data: TensorDict) -> Tensor | None:
    """The step from which a trajectory's robot is another, ``(rows,)``; 0: it stays.

    None where no robot of the data ``[rows, steps]`` changes.
    """
    parameters = data.get(PARAMETERS, None)
    if parameters is None:
        return None
    is_new = (parameters[:, 1:] != parameters[:, :-1]).any(-1)  # (rows, steps - 1)
    when = torch.where(is_new.any(1), is_new.int().argmax(1) + 1, 0)
    return when if bool(is_new.any()) else None
