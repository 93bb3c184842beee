"""Tokens, targets and their statistics from a data set."""

from typing import cast

import torch
from tensordict import TensorDict
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_nerd.configs import NO_PREDICTIONS, FeatureConfig
from torchrl_nerd.keys import (
    CTRL,
    JOINT_TORQUE,
    NEXT_QPOS,
    NEXT_QVEL,
    PARAMETERS,
    QPOS,
    QVEL,
    TERRAIN,
)
from torchrl_nerd.modules.nerd import TARGET, TOKEN, NeRD, SceneFeatures
from torchrl_nerd.modules.symmetric import SignedCopies
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.commands import drive_of
from torchrl_nerd.transforms import StateDelta, Stats

PART = 6400  # samples turned into tokens at a time: fit the cache


def raw_tokens(
    tokens: SceneFeatures, state_delta: StateDelta, data: TensorDict
) -> tuple[Tensor, Tensor]:
    """Unnormalised tokens ``(*batch, F)`` and targets ``(*batch, D)``, float64."""
    state, terrain = (data[QPOS], data[QVEL]), data.get(TERRAIN, None)
    told = tokens.told(data.get(PARAMETERS, None))
    drive = drive_of(data[JOINT_TORQUE], data.get(CTRL, None), told)
    token = tokens(*state, drive, terrain)
    return token, state_delta.delta(*state, data[NEXT_QPOS], data[NEXT_QVEL])


def data_stats(
    scene: Scene, data: TensorDict, config: FeatureConfig = NO_PREDICTIONS
) -> dict[NestedKey, Stats]:
    """Exact statistics of a scene's features and targets over a data set."""
    return stats_of(SceneFeatures(scene, config), StateDelta(scene), data)


def stats_of(
    tokens: SceneFeatures, state_delta: StateDelta, data: TensorDict
) -> dict[NestedKey, Stats]:
    """Exact statistics of tokens and targets over a data set.

    Computed where the data are, and given on the CPU.
    """
    device = data[QPOS].device
    encode = tokens.to(device), cast(StateDelta, state_delta.to(device))
    parts = (raw_tokens(*encode, part) for part in data.split(_together(data)))
    both = ([Stats.of(values) for values in part] for part in parts)
    found = map(Stats.merge_all, zip(*both, strict=True))
    token, target = (Stats(x.count, x.mean.cpu(), x.m2.cpu()) for x in found)
    return {TOKEN: token, TARGET: target}


def _together(data: TensorDict) -> int:
    """Trajectories of a part, however long they are."""
    return max(1, PART * len(data) // max(1, data.numel()))


def normalised(model: NeRD, data: TensorDict) -> tuple[Tensor, Tensor]:
    """Features and targets of transitions, normalised, float32 ``(*batch, D)``."""
    tokens, targets = (
        torch.empty(*data.batch_size, size, device=data[QPOS].device)
        for size in (model.scene_features.size, model.state_delta.size)
    )
    parts = (x.split(_together(data)) for x in (data, tokens, targets))
    for part, *places in zip(*parts, strict=True):  # filled in place: memory is short
        raw = raw_tokens(model.scene_features, model.state_delta, part)
        for place, key, value in zip(places, (TOKEN, TARGET), raw, strict=True):
            place.copy_(model.normalize.normalize(key, value))
    return tokens, targets


def cover(
    model: NeRD,
    data: TensorDict,
    samples: tuple[Tensor, Tensor] | None = None,
    copies: SignedCopies | None = None,
) -> None:
    """Fit a model's training range and out-of-distribution score to its data, in place.

    ``samples``: normalised features and targets, where they are there already; ``copies``
    are the symmetric ones of the features, which the score then covers too.
    """
    features, targets = (x.flatten(0, -2) for x in samples or normalised(model, data))
    seen = (data[key].flatten(0, -2) for key in (NEXT_QPOS, NEXT_QVEL))
    model.training_range.fit(features, targets, *seen)
    model.ood.fit(features, copies)
