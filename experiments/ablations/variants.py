"""What is tried on each scene: the base, and it with one choice undone."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import cast

from tensordict import TensorDict

from torchrl_nerd.modules.nerd import TARGET, TOKEN, NeRD
from torchrl_nerd.modules.networks import GRUConfig, MLPConfig, NetworkConfig
from torchrl_nerd.modules.transformer import TransformerConfig
from torchrl_nerd.scenes import Scene
from torchrl_nerd.training.samples import stats_of
from torchrl_nerd.transforms import StateDelta, Stats
from torchrl_nerd.transforms.scene_features import SceneFeatures

from . import features, targets
from .networks import LSTMConfig, MarkovConfig

BASE = "base"
BAND = 10  # paper: h
THINNING = 10  # every tenth trajectory tells the statistics


@dataclass(frozen=True)
class Variant:
    """One way to put the parts together.

    | field | meaning |
    |---|---|
    | ``what`` | what differs from the base, in a few words |
    | ``tokens``, ``target`` | what the network sees and predicts |
    | ``network`` | all have some 100,000 weights between their ends |
    | ``raw`` | of `TOKEN` and `TARGET`, what is not normalised |
    | ``has_muon`` | whether matrices are Muon's; else all weights are AdamW's |
    | ``window`` | tokens of a sequence, recomputed at every step; None: streaming |
    """

    what: str
    tokens: Callable[[Scene], SceneFeatures] = features.base
    target: Callable[[Scene], StateDelta] = StateDelta
    network: NetworkConfig | LSTMConfig | MarkovConfig = TransformerConfig()
    raw: tuple[str, ...] = ()
    has_muon: bool = True
    window: int | None = None

    def build(self, scene: Scene, data: TensorDict) -> NeRD:
        """A model that has learned nothing, with the statistics of its data."""
        tokens, target = self.tokens(scene), self.target(scene)
        stats = stats_of(tokens, target, cast(TensorDict, data[::THINNING]))
        for name, size in ((TOKEN, tokens.size), (TARGET, target.size)):
            if name in self.raw:
                stats[name] = Stats.unit(size)
        network = cast(NetworkConfig, self.network)
        return NeRD(scene, tokens.config, network, stats, tokens, target)


COMMON = {
    BASE: Variant("robot-centric, relative, normalised; transformer 2x64, h = 10"),
    "absolute": Variant("predicts the next state", target=targets.AbsoluteState),
    "no trapezoid": Variant(
        "predicts the plain change of position", target=targets.PlainDelta
    ),
    "end to end": Variant(
        "state in world axes and torque, no contacts",
        tokens=features.EndToEndTokens,
        target=targets.WorldDelta,
    ),
    "no input normalisation": Variant("features in their own units", raw=(TOKEN,)),
    "no output normalisation": Variant("targets in their own units", raw=(TARGET,)),
    "full features": Variant("the paper's input, whole", tokens=features.PaperTokens),
    "no predictions": Variant(
        "no predicted forces, predicted penetration at constant velocity",
        tokens=SceneFeatures,
    ),
}

NETWORKS = {
    "AdamW": Variant("for Muon", has_muon=False),
    "MLP": Variant("3 blocks of 64, for the transformer", network=MLPConfig(3, 64)),
    "GRU": Variant("128 wide, for the transformer", network=GRUConfig()),
    "LSTM": Variant("112 wide, for the transformer", network=LSTMConfig()),
    "h = 1": Variant("sees the present token alone", network=MarkovConfig()),
    "h = 5": Variant("a band of 5", network=TransformerConfig(band=5)),
    "h = 20": Variant("a band of 20", network=TransformerConfig(band=20)),
    "window": Variant(
        "trained on 10 tokens, which are recomputed at every step", window=BAND
    ),
}

VARIANTS: Mapping[str, Mapping[str, Variant]] = {
    "double_pendulum": {
        **COMMON,
        "link frame": Variant(
            "contacts in the first link's frame", tokens=features.LinkTokens
        ),
        **NETWORKS,
    },
    "ant": {
        **COMMON,
        "distances alone": Variant(
            "of contacts distances and normals, no velocities, depths to come or forces",
            tokens=features.DistanceTokens,
        ),
        "world frame": Variant(
            "state, contacts and target in world axes",
            tokens=features.WorldTokens,
            target=targets.WorldDelta,
        ),
        "quaternion": Variant(
            "the base's turn as four numbers", target=targets.QuaternionDelta
        ),
        **NETWORKS,
    },
}
"""Scene -> name -> variant; the order is that of the tables."""
