"""Data augmentation by a robot's symmetries: each sample as a random one of its images.

The image of a token or target under an isometry is a signed permutation of its entries.
"""

from collections.abc import Sequence
from typing import cast

import torch
from tensordict import TensorDict
from tensordict.utils import NestedKey
from torch import Generator, Tensor, nn

from torchrl_nerd.configs import NO_PREDICTIONS, FeatureConfig
from torchrl_nerd.geometry.base import keep_constants, keep_indices
from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.modules.nerd import TARGET, TOKEN, SceneFeatures
from torchrl_nerd.scenes import Scene
from torchrl_nerd.training.samples import raw_tokens
from torchrl_nerd.training.symmetry import find_isometries, states_in_contact
from torchrl_nerd.transforms import Normalize, StateDelta, Stats

RTOL = 1e-7  # of equal entries, relative to the largest of a column
STATS_TOL = 1e-3  # standard deviations: more than rounding, less than a network notices
STATES = 512  # whose features tell which entry of an image is which of the original
OVERSHOOT = 0.2  # of a joint's range, beyond its limits
MAX_DEPTHS = 0.01, 1.0  # m: with some of the contact points in the ground, and with all


class SignedPermutations(nn.Module):
    """Images of a kind of vector under isometries: ``image[j] = sign[j] x[source[j]]``.

    Found from samples ``(N, F)`` and their images under each isometry. Every entry that is
    ever not zero must be so in a sample.

    Raises:
        ValueError: an entry of an image that is none of the original's.
    """

    sources: Tensor
    signs: Tensor

    def __init__(self, original: Tensor, images: Sequence[Tensor]) -> None:
        super().__init__()
        sources, signs = zip(*(_match(original, x) for x in images), strict=True)
        keep_indices(self, sources=sources)  # (isometries, F)
        keep_constants(self, signs=signs)

    def forward(self, x: Tensor, choice: Tensor) -> Tensor:
        """Images of ``x (rows, length, F)``, each row by isometry ``choice (rows,)``."""
        sources = self.sources[choice][:, None].expand(x.shape)  # (rows, length, F)
        return x.gather(-1, sources) * self.signs[choice][:, None].to(x.dtype)

    def complete(self, stats: Stats) -> Stats:
        """Statistics of all images: with these, normalised vectors map as raw ones do."""
        return Stats.merge_all(
            Stats(stats.count, sign * stats.mean[source], stats.m2[source])
            for source, sign in zip(self.sources, self.signs, strict=True)
        )

    def keep(self, mean: Tensor, std: Tensor) -> bool:
        """Whether images of samples of these statistics ``(F,)`` have the same ones."""
        means, stds = self.signs * mean[self.sources], std[self.sources]
        apart = torch.maximum((means - mean).abs(), (stds - std).abs())
        return bool((apart < STATS_TOL * std).all())


def _match(original: Tensor, image: Tensor) -> tuple[list[int], list[float]]:
    scale = RTOL * (original.abs().amax(0) + 1e-3)
    sources, signs = [], []
    for j, column in enumerate(image.T):
        for sign in (1.0, -1.0):
            apart = (column[:, None] - sign * original).abs().amax(0)
            fits = (apart <= scale).nonzero()[:, 0].tolist()
            if fits:  # of several alike, such as constants, its own
                sources.append(j if j in fits else fits[0])
                signs.append(sign)
                break
        else:
            raise ValueError(f"entry {j} of the image is no entry of the original")
    return sources, signs


class Symmetry(nn.Module):
    """Isometries of a robot, the identity first, and their effect on tokens and targets.

    Raises:
        ValueError: see `find_isometries`; a feature that is zero in all of these states;
            a scene whose parameters differ from row to row.
    """

    def __init__(self, scene: Scene, config: FeatureConfig = NO_PREDICTIONS) -> None:
        super().__init__()
        if scene.variation is not None:
            raise ValueError("expected a varied scene without use_symmetry, got both")
        self.isometries = nn.ModuleList(find_isometries(scene))
        encode = SceneFeatures(scene, config), StateDelta(scene)
        parts = [states_in_contact(scene, STATES // 2, depth) for depth in MAX_DEPTHS]
        states, model = cast(TensorDict, TensorDict.cat(parts)), scene.model
        share = torch.linspace(-OVERSHOOT, 1.0 + OVERSHOOT, STATES).double()
        order = Generator().manual_seed(0)
        for joint in model.jnt_limited.nonzero()[0]:  # some beyond either end
            low, high = model.jnt_range[joint]
            mixed = share[torch.randperm(STATES, generator=order)]
            states[QPOS][:, model.jnt_qposadr[joint]] = low + (high - low) * mixed
        for key in (QPOS, QVEL):  # a change between any two states will do
            states["next", key] = states[key].roll(1, 0)
        images = [raw_tokens(*encode, image(states)) for image in self.isometries]
        still = (images[0][0] == 0.0).all(0).nonzero()[:, 0].tolist()
        if still and len(images) > 1:
            raise ValueError(
                f"expected random states of '{scene.name}' to fill every feature, got "
                f"none for {still}: train without use_symmetry"
            )
        tokens, targets = zip(*images, strict=True)
        self.tokens = SignedPermutations(tokens[0], tokens)
        self.targets = SignedPermutations(targets[0], targets)

    def complete(self, stats: dict[NestedKey, Stats]) -> dict[NestedKey, Stats]:
        """Statistics of tokens and targets with all their images."""
        tokens = self.tokens.complete(stats[TOKEN])
        return {TOKEN: tokens, TARGET: self.targets.complete(stats[TARGET])}

    def keeps(self, normalize: Normalize) -> bool:
        """Whether images of normalised tokens and targets are those of raw ones."""
        both = (TOKEN, self.tokens), (TARGET, self.targets)
        return all(x.keep(normalize.mean(key), normalize.std(key)) for key, x in both)
