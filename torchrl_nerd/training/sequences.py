"""Training data on the device: tokens and targets once, batches by one gather."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, cast

import torch
from tensordict import TensorDict
from tensordict.utils import NestedKey
from torch import Generator, Tensor

from torchrl_nerd.configs import NO_PREDICTIONS, FeatureConfig
from torchrl_nerd.keys import JOINT_TORQUE, NEXT_QPOS, NEXT_QVEL, QPOS, QVEL, TERRAIN
from torchrl_nerd.modules.features import SceneFeatures
from torchrl_nerd.modules.nerd import TARGET, TOKEN, NeRD
from torchrl_nerd.scenes import Scene
from torchrl_nerd.training import ranks
from torchrl_nerd.training.images import Images, telling_rows
from torchrl_nerd.training.symmetry import Isometry, find_isometries, states_in_contact
from torchrl_nerd.transforms import Normalize, StateDelta, Stats

PART = 1024  # trajectories turned into tokens at a time
FEW = 32  # trajectories that an analytic step takes at a time: fits the cache
LOOK = 8  # parts in which images of tokens are looked for
# ... and beside them states in which every contact point has features, which those of a
# small data set may never have
LOW_ROWS, SUNKEN = 256, 1.0  # -, m


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
            return cls(features, model.zero.float(), model.one.float())
        parts = []
        for part in data.split(FEW):
            state, terrain = (part[QPOS], part[QVEL]), part.get(TERRAIN, None)
            found = model.encode(*state, part[JOINT_TORQUE], terrain)
            parts.append([x.float() for x in found[1:]])
        return cls(*(torch.cat(x) for x in zip(*parts, strict=True)))

    def __getitem__(self, index: tuple[Tensor, Tensor]) -> "Inputs":  # pyright: ignore
        """Those of some samples."""
        return Inputs(*(x[index] if x.ndim else x for x in tuple(self)))

    def change(self, output: Tensor) -> Tensor:
        """The normalised change ``(*batch, D)`` that a network's output makes."""
        return self.base + self.gate * output

    def to(self, device: torch.device) -> "Inputs":
        """The same on another device."""
        return Inputs(*(x.to(device) for x in tuple(self)))

    def share(self, share: Callable[[Tensor], Tensor]) -> "Inputs":
        """The part of each that a rank takes."""
        return Inputs(*(share(x) if x.ndim else x for x in tuple(self)))


@dataclass(frozen=True, eq=False)
class Symmetry:
    """Isometries of a robot and what they do to its tokens and targets.

    | field | meaning |
    |---|---|
    | ``isometries`` | the identity first |
    | ``images`` | of `TOKEN` and `TARGET` |
    """

    isometries: tuple[Isometry, ...]
    images: dict[str, Images]

    @classmethod
    def of(
        cls, scene: Scene, data: TensorDict, config: FeatureConfig = NO_PREDICTIONS
    ) -> "Symmetry":
        """The symmetry of a robot, its features' images found in samples of ``data``."""
        isometries = find_isometries(scene)
        tokens, targets = SceneFeatures(scene, config), StateDelta(scene)
        low = states_in_contact(scene, LOW_ROWS, SUNKEN)

        def telling(flat: TensorDict) -> TensorDict:
            rows = [telling_rows(x) for x in raw_tokens(tokens, targets, flat)]
            return cast(TensorDict, flat[torch.cat(rows).unique()])

        # the largest of all are among the largest of each part, which takes less memory
        parts = data[: LOOK * PART].split(PART)
        found = [telling(cast(TensorDict, part.flatten(0, 1))) for part in parts]
        some = telling(cast(TensorDict, TensorDict.cat(found)))
        token_images, target_images = [], []
        for isometry in isometries:
            token, target = raw_tokens(tokens, targets, isometry(some))
            image = isometry(low)
            keys = (QPOS, QVEL, JOINT_TORQUE)
            other = tokens(*(image[k] for k in keys), image.get(TERRAIN, None))
            token_images.append(torch.cat((token, other)))
            target_images.append(target)
        pairs = ((TOKEN, token_images), (TARGET, target_images))
        images = {key: Images(x[0], x) for key, x in pairs}
        return cls(isometries, images)

    def complete(self, stats: dict[NestedKey, Stats]) -> dict[NestedKey, Stats]:
        """Statistics of tokens and targets with all their images."""
        return {key: self.images[str(key)].complete(x) for key, x in stats.items()}

    def keeps(self, normalize: Normalize) -> bool:
        """Whether images of normalised tokens and targets are those of raw ones."""
        return all(
            image.keep(normalize.mean(key), normalize.std(key))
            for key, image in self.images.items()
        )

    def to(self, device: torch.device) -> "Symmetry":
        """The same on another device."""
        isometries = tuple(isometry.to(device) for isometry in self.isometries)
        images = {key: image.to(device) for key, image in self.images.items()}
        return Symmetry(isometries, images)


class Sequences:
    """Batches of sequences from a data set.

    Args:
        model: its features and statistics.
        data: ``[trajectories, steps]``.
        device: where batches are wanted.
        symmetry: show each sample as a random one of its images.

    Raises:
        ValueError: symmetry images of a hybrid, whose analytic change has none.
    """

    def __init__(
        self,
        model: NeRD,
        data: TensorDict,
        device: torch.device,
        symmetry: Symmetry | None = None,
    ) -> None:
        if symmetry is not None and model.kind == "hybrid":
            raise ValueError(
                "expected training without use_symmetry for a hybrid, got it with one"
            )
        features, targets = normalised(model, data)
        self.features, self.targets = features, targets.to(device)
        self.inputs = Inputs.of(model, data, features).to(device)
        self.data = data.to(device)
        self.symmetry = symmetry.to(device) if symmetry else None
        self.steps = data.batch_size[1]

    def pick(
        self, rows: int, length: int, generator: Generator
    ) -> tuple[Tensor, Tensor]:
        """Random trajectories and times: indices ``(rows, 1), (rows, length)``."""
        device = self.targets.device
        row = torch.randint(len(self.targets), (rows, 1), generator=generator)
        last = self.steps - length + 1
        start = torch.randint(last, (rows, 1), generator=generator)
        return row.to(device), (start + torch.arange(length)).to(device)

    def one_step(
        self, rows: int, length: int, generator: Generator
    ) -> tuple["Inputs", Tensor]:
        """Network inputs and targets of ``(rows, length)`` samples."""
        row, time_index = self.pick(rows, length, generator)
        inputs, targets = self.inputs[row, time_index], self.targets[row, time_index]
        if self.symmetry is None:
            return inputs, targets
        count = len(self.symmetry.isometries)
        choice = torch.randint(count, (rows,), generator=generator).to(targets.device)
        images = self.symmetry.images
        tokens = images[TOKEN](inputs.token, choice)
        return inputs._replace(token=tokens), images[TARGET](targets, choice)

    def rollout(
        self, rows: int, length: int, generator: Generator
    ) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
        """True states ``(rows, length + 1, ...)``, torques and ground."""
        row, time_index = self.pick(rows, length, generator)
        batch = cast(TensorDict, self.data[row, time_index])
        if self.symmetry is not None:  # the rows are in no order: a part for each
            isometries = self.symmetry.isometries
            parts = zip(isometries, batch.chunk(len(isometries)), strict=False)
            images = [isometry(cast(TensorDict, part)) for isometry, part in parts]
            batch = cast(TensorDict, torch.cat(images))  # pyright: ignore
        qpos = torch.cat((batch[QPOS], batch[NEXT_QPOS][:, -1:]), 1)
        qvel = torch.cat((batch[QVEL], batch[NEXT_QVEL][:, -1:]), 1)
        terrain = batch.get(TERRAIN, None)
        ground = None if terrain is None else terrain[:, 0]
        return qpos, qvel, batch[JOINT_TORQUE], ground


def raw_tokens(
    tokens: SceneFeatures, state_delta: StateDelta, data: TensorDict
) -> tuple[Tensor, Tensor]:
    """Unnormalised tokens ``(*batch, F)`` and targets ``(*batch, D)``, float64."""
    terrain = data.get(TERRAIN, None)
    token = tokens(data[QPOS], data[QVEL], data[JOINT_TORQUE], terrain)
    target = state_delta.delta(data[QPOS], data[QVEL], data[NEXT_QPOS], data[NEXT_QVEL])
    return token, target


def data_stats(
    scene: Scene, data: TensorDict, config: FeatureConfig = NO_PREDICTIONS
) -> dict[NestedKey, Stats]:
    """Exact statistics of a scene's features and targets over a data set."""
    return stats_of(SceneFeatures(scene, config), StateDelta(scene), data)


def stats_of(
    tokens: SceneFeatures, state_delta: StateDelta, data: TensorDict
) -> dict[NestedKey, Stats]:
    """Exact statistics of tokens and targets over a data set, each rank's part of it."""
    size = min(PART, -(-len(data) // ranks.world()))
    mine = data.split(size)[ranks.rank() :: ranks.world()]
    parts = [raw_tokens(tokens, state_delta, part) for part in mine]
    stats: dict[NestedKey, Stats] = {}
    for index, key in enumerate((TOKEN, TARGET)):
        merged, *rest = (Stats.of(part[index]) for part in parts)
        for other in rest:
            merged = merged.merge(other)
        stats[key] = ranks.merge_stats(merged)
    return stats


def normalised(model: NeRD, data: TensorDict) -> tuple[Tensor, Tensor]:
    """Features and targets of transitions, normalised, float32 ``(*batch, D)``."""
    tokens, targets = (
        torch.empty(*data.batch_size, size, device=data[QPOS].device)
        for size in (model.scene_features.size, model.state_delta.size)
    )
    for part, *places in zip(
        data.split(PART), tokens.split(PART), targets.split(PART), strict=True
    ):
        raw = raw_tokens(model.scene_features, model.state_delta, part)
        for place, key, value in zip(places, (TOKEN, TARGET), raw, strict=True):
            place.copy_(model.normalize.normalize(key, value))
    return tokens, targets


def cover(
    model: NeRD, data: TensorDict, samples: tuple[Tensor, Tensor] | None = None
) -> None:
    """Fit a model's training range and out-of-distribution score to its data.

    Args:
        model: changed in place.
        data: transitions, ``[trajectories, steps]``.
        samples: their normalised features and targets, where they are there already.
    """
    features, targets = (x.flatten(0, -2) for x in samples or normalised(model, data))
    seen = (data[key].flatten(0, -2) for key in (NEXT_QPOS, NEXT_QVEL))
    model.training_range.fit(features, targets, *seen)
    model.ood.fit(features)
