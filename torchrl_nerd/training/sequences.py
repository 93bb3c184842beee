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

    With ``symmetry`` each sample of a learned model is shown as a random one of its
    symmetric copies.
    """

    def __init__(
        self, model: NeRD, data: TensorDict, symmetry: Symmetry | None = None
    ) -> None:
        self.features, self.targets = normalised(model, data)
        self.inputs, self.data = Inputs.of(model, data, self.features), data
        self.symmetry = symmetry.to(self.targets.device) if symmetry else None
        self.scene, self.steps = model.scene, data.batch_size[1]
        self.change, self.longest = change_times(data), self.steps
        if self.change is not None:
            # the longer part of each trajectory, and the least of these
            part = torch.maximum(self.change, self.steps - self.change)
            self.longest = int(part.min())

    def pick(
        self, batch_size: int, length: int, generator: Generator
    ) -> tuple[Tensor, Tensor]:
        """Random trajectories and times: indices ``(batch, 1), (batch, length)``."""
        size = (batch_size, 1)
        trajectory = torch.randint(len(self.targets), size, generator=generator)
        last = self.steps - length + 1
        start = torch.randint(last, size, generator=generator)
        trajectory, start = self._sent(trajectory), self._sent(start)
        return trajectory, start + torch.arange(length, device=start.device)

    def _sent(self, drawn: Tensor) -> Tensor:
        """Random numbers of the host on the device, which it does not wait for."""
        return drawn.to(self.targets.device, non_blocking=True)

    def one_step(
        self, batch_size: int, length: int, generator: Generator
    ) -> tuple["Inputs", Tensor]:
        """Network inputs and targets of ``(batch_size, length)`` samples."""
        index = self.pick(batch_size, length, generator)
        targets = self.targets[index]  # (batch, length, D)
        inputs = self.inputs.each(lambda x: x[index])
        if self.symmetry is None:
            return inputs, targets
        count = len(self.symmetry.isometries)
        choice = self._sent(torch.randint(count, (batch_size,), generator=generator))
        token = self.symmetry.tokens(inputs.token, choice)
        return inputs._replace(token=token), self.symmetry.targets(targets, choice)

    def _of_one_robot(self, trajectory: Tensor, time_index: Tensor) -> Tensor:
        """Windows ``(batch, length)`` moved behind a change of robot, or before it."""
        assert self.change is not None
        first, length = time_index[:, :1], time_index.shape[1]
        change = self.change[trajectory]
        is_mixed = (first < change) & (change < first + length)  # (batch, 1)
        is_early = change + length > self.steps
        moved = torch.where(is_early, (change - length).clamp_min(0), change)
        return time_index - first + torch.where(is_mixed, moved, first)

    def expect_rollouts(self, length: int) -> None:
        """Refuse rollouts that no trajectory has.

        Raises:
            ValueError: longer than one robot of some trajectory stays.
        """
        if length > self.longest:
            raise ValueError(
                f"expected rollouts, history included, of at most {self.longest} steps "
                f"with robots that change, got {length}"
            )

    def rollout(
        self, batch_size: int, length: int, generator: Generator
    ) -> tuple[Tensor, Tensor, Tensor, Tensor | None, Tensor | None]:
        """``qpos``, ``qvel (batch, length + 1, ...)``, commands, ground, parameters."""
        trajectory, time_index = self.pick(batch_size, length, generator)
        if self.change is not None:
            time_index = self._of_one_robot(trajectory, time_index)
        batch = cast(TensorDict, self.data[trajectory, time_index])
        if self.symmetry is not None:  # samples are in no order: a part for each
            isometries = list(self.symmetry.isometries)
            first = int(torch.randint(len(isometries), (), generator=generator))
            isometries = isometries[first:] + isometries[:first]
            parts = zip(isometries, batch.chunk(len(isometries)), strict=False)
            copies = [isometry(part) for isometry, part in parts]
            batch = cast(TensorDict, torch.cat(copies))  # pyright: ignore
        qpos = torch.cat((batch[QPOS], batch[NEXT_QPOS][:, -1:]), 1)
        qvel = torch.cat((batch[QVEL], batch[NEXT_QVEL][:, -1:]), 1)
        first = cast(TensorDict, batch[:, 0])  # these are the same at all times
        own = first.get(TERRAIN, None), first.get(PARAMETERS, None)  # (batch, size)
        return qpos, qvel, command_of(self.scene, batch), *own


def change_times(data: TensorDict) -> Tensor | None:
    """The step from which a trajectory's robot is another; 0: it stays.

    None where no robot of the data ``[trajectories, steps]`` changes.
    """
    parameters = data.get(PARAMETERS, None)
    if parameters is None or parameters.shape[1] < 2:
        return None
    # (trajectories, steps - 1)
    is_new = (parameters[:, 1:] != parameters[:, :-1]).any(-1)
    when = torch.where(is_new.any(1), is_new.int().argmax(1) + 1, 0)
    return when if bool(is_new.any()) else None
