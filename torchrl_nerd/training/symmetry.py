"""Symmetries of a robot, and data augmentation by them: symmetric copies of samples.

A symmetric copy of a token or target is a signed permutation of its entries.
"""

from typing import cast

import torch
from tensordict import TensorDict
from tensordict.utils import NestedKey
from torch import nn

from torchrl_nerd.configs import NO_PREDICTIONS, FeatureConfig
from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.modules.nerd import TARGET, TOKEN, SceneFeatures
from torchrl_nerd.modules.symmetric import SignedCopies
from torchrl_nerd.modules.training_range import TrainingRange
from torchrl_nerd.scenes import Scene
from torchrl_nerd.settings import SettingError
from torchrl_nerd.training.contact_states import states_in_contact
from torchrl_nerd.training.isometries import find_isometries
from torchrl_nerd.training.isometry import Isometry
from torchrl_nerd.training.samples import raw_tokens
from torchrl_nerd.training.signed_permutations import SignedPermutations, match_entries
from torchrl_nerd.transforms import Normalize, StateDelta, Stats

STATES = 512  # whose features tell which entry of a copy is which of the original
MAX_DEPTHS = 0.01, 1.0  # m: with some of the contact points in the ground, and with all


class Symmetry(nn.Module):
    """Isometries of a robot, the identity first, and their effect on tokens and targets.

    Of `find_isometries` those that the features have too: a shape's contact points need
    not be as symmetric as the shape. ``is_near``: those that hold nearly as well.

    Raises:
        ValueError: see `find_isometries`.
    """

    def __init__(
        self,
        scene: Scene,
        config: FeatureConfig = NO_PREDICTIONS,
        is_near: bool = False,
    ) -> None:
        super().__init__()
        self.is_near, self.name = is_near, scene.name
        group = find_isometries(scene, is_near)
        encode = SceneFeatures(scene, config), StateDelta(scene)
        parts = [states_in_contact(scene, STATES // 2, depth) for depth in MAX_DEPTHS]
        states = cast(TensorDict, TensorDict.cat(parts))
        for key in (QPOS, QVEL):  # a change between any two states will do
            states["next", key] = states[key].roll(1, 0)
        here = raw_tokens(*encode, states)
        self.is_still = (here[0] == 0.0).all(0)  # (F,): not seen to move
        kept, found = [], []
        for isometry in group:
            there = raw_tokens(*encode, isometry(states))
            matched = [match_entries(*x) for x in zip(here, there, strict=True)]
            if None not in matched:
                kept.append(isometry)
                found.append(matched)
        self.isometries = nn.ModuleList(kept)
        tokens, targets = zip(*found, strict=True)
        self.tokens, self.targets = map(SignedPermutations, (tokens, targets))

    @classmethod
    def most(cls, scene: Scene, config: FeatureConfig = NO_PREDICTIONS) -> "Symmetry":
        """The robot's symmetries; where a network can have none, those that hold nearly."""
        exact = cls(scene, config)
        if exact.counts() != [1]:
            return exact
        near = cls(scene, config, is_near=True)
        return exact if near.counts() == [1] else near

    def complete(self, stats: dict[NestedKey, Stats]) -> dict[NestedKey, Stats]:
        """Statistics of tokens and targets with all their symmetric copies.

        Raises:
            ValueError: a feature of the data that is zero in all of `STATES`, so that
                nothing tells where symmetries put it.
        """
        token = stats[TOKEN]
        moves = (token.mean != 0.0) | (token.m2 != 0.0)  # (F,)
        unseen = (moves & self.is_still.to(moves.device)).nonzero()[:, 0].tolist()
        if unseen and len(self.isometries) > 1:
            raise ValueError(
                f"expected random states of '{self.name}' to fill every feature of the "
                f"data, got none for {unseen}: train without use_symmetry and "
                "with symmetries 1"
            )
        both = (TOKEN, self.tokens), (TARGET, self.targets)
        return {key: copies.complete(stats[key]) for key, copies in both}

    def counts(self) -> list[int]:
        """Numbers of symmetries that a network of the robot can have, 1 the first."""
        most = len(self.isometries)
        powers = (2**n for n in range(most.bit_length()))
        return [count for count in powers if self.targets.mirrors(count) is not None]

    def mirrors(self, count: int) -> tuple[SignedCopies, SignedCopies]:
        """What ``count`` products of commuting mirrors make of tokens and targets.

        Raises:
            SettingError: the robot has fewer.
        """
        some = self.targets.mirrors(count)
        if some is None:
            known = " or ".join(map(str, self.counts()))
            raise SettingError(
                f"expected symmetries {known}, the mirrors, half turns and their products "
                "that commute with each other, and that MuJoCo's step and the features "
                f"of '{self.name}' have, got {count}"
            )
        both = ((x.sources[some], x.signs[some]) for x in (self.tokens, self.targets))
        return next(both), next(both)

    def complete_range(self, seen: TrainingRange) -> None:
        """Widen bounds of normalised samples to those of all symmetric copies, in place."""
        for name, copies in (("feature", self.tokens), ("target", self.targets)):
            low, high = (seen.get_buffer(f"{name}_{end}") for end in ("low", "high"))
            ends = (
                torch.stack((low, high))[:, copies.sources] * copies.signs
            )  # (2, K, D)
            low.copy_(ends.amin((0, 1)))
            high.copy_(ends.amax((0, 1)))
        group = [cast(Isometry, isometry) for isometry in self.isometries]
        q, v = group[0].base
        joints = torch.stack((seen.qpos_low, seen.qpos_high))[:, q:]
        ends = torch.stack([isometry.joints(joints) for isometry in group])  # (K, 2, .)
        seen.qpos_low[q:] = ends.amin((0, 1))
        seen.qpos_high[q:] = ends.amax((0, 1))
        speeds = [isometry.joints(seen.speed[v:]).abs() for isometry in group]
        seen.speed[v:] = torch.stack(speeds).amax(0)  # the base's are norms of vectors

    def keeps(self, normalize: Normalize) -> bool:
        """Whether copies of normalised tokens and targets are those of raw ones."""
        both = (TOKEN, self.tokens), (TARGET, self.targets)
        return all(x.keep(normalize.mean(key), normalize.std(key)) for key, x in both)
