"""Neural Robot Dynamics: a network predicts the change of a robot's state.

    qpos, qvel, drive, terrain
      -> features        robot-centric state, contacts, drive         (*batch, F)
      -> normalise, clamp to the training range
      -> network         causal transformer, MLP or GRU               (*batch, D)
      -> denormalise     velocity change and position residual, D = 2 nv
      -> integrate       next qpos, qvel

The drive is the joint torque and servos' controls. NeRD (CoRL 2025), sections 3.2 to 3.4.
"""

import copy
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, NamedTuple

import torch
from tensordict.utils import NestedKey
from torch import Tensor, nn

from torchrl_nerd.configs import FeatureConfig
from torchrl_nerd.modules.networks import NetworkConfig
from torchrl_nerd.modules.training_range import OODScore, Sleep, TrainingRange
from torchrl_nerd.scenes.scene import Scene
from torchrl_nerd.scenes.variation import expect_told, ranges_of
from torchrl_nerd.transforms import Normalize, StateDelta, Stats
from torchrl_nerd.transforms.scene_features import SceneFeatures

TOKEN, TARGET = "token", "target"  # keys of the statistics

State = tuple[Tensor, Tensor]
"""``qpos (*batch, nq)`` and ``qvel (*batch, nv)``, float64."""


class Encoded(NamedTuple):
    """What a state is to the network, and what its output is added to."""

    features: Tensor  # (*batch, F), normalised, as they are
    token: Tensor  # (*batch, token_size), the network's input
    base: Tensor | float  # (*batch, D): normalised change without the network
    gate: Tensor | float  # (*batch, 1): share of the network's output that counts


class NeRD(nn.Module):
    """The learned solver of one robot: state, torque and ground in, next state out.

    Args:
        scene: the robot and its ground.
        features: which predictions of the contact law are among its features.
        network: size and kind of the network.
        stats: of raw features and targets; zero mean and unit variance where not given
            (weights that are yet to be loaded).
        scene_features: what it sees of a state; `SceneFeatures` where not given.
        state_delta: what it predicts; see `StateDelta`.
    """

    kind: ClassVar[str] = "learned"
    network: Any  # has `empty_memory(rows)`, `step(token, memory)` and `read`
    compile_single_threaded: bool = True  # in parts, a thread each

    def __init__(
        self,
        scene: Scene,
        features: FeatureConfig,
        network: NetworkConfig,
        stats: Mapping[NestedKey, Stats] | None = None,
        scene_features: SceneFeatures | None = None,
        state_delta: StateDelta | None = None,
    ) -> None:
        super().__init__()
        self.scene, self.config = scene, network
        self.reference_ratio = scene.reference_ratio  # of the solver it learned from
        self.scene_features = scene_features or SceneFeatures(scene, features)
        self.state_delta = state_delta or StateDelta(scene)
        num_features, num_outputs = self.scene_features.size, self.state_delta.size
        widths: dict[NestedKey, int] = {TOKEN: num_features, TARGET: num_outputs}
        unit = {key: Stats.unit(width) for key, width in widths.items()}
        self.normalize = Normalize(stats or unit)
        self.training_range = TrainingRange(scene, num_features, num_outputs)
        self.ood, self.sleep = OODScore(num_features), Sleep(scene)
        self.network = network.build(self.token_size, num_outputs)

    @property
    def token_size(self) -> int:
        """Width of the network's input."""
        return self.scene_features.size

    def features(
        self, qpos: Tensor, qvel: Tensor, drive: Tensor, terrain: Tensor | None
    ) -> Tensor:
        """Normalised features ``(*batch, F)``, float64, unclamped."""
        raw = self.scene_features(qpos, qvel, drive, terrain)
        return self.normalize.normalize(TOKEN, raw)

    def encode(
        self, qpos: Tensor, qvel: Tensor, drive: Tensor, terrain: Tensor | None
    ) -> Encoded:
        """The network's input for float64 states and drives, and what it adds to."""
        features = self.features(qpos, qvel, drive, terrain)
        token = self.training_range.clamp_features(features).to(self.dtype)
        return Encoded(features, token, 0.0, 1.0)

    def decode(self, state: State, encoded: Encoded, output: Tensor) -> State:
        """The next state from the network's output ``(*batch, D)``.

        change = base + gate * output, denormalised, clamped and integrated.
        """
        change = encoded.base + encoded.gate * output.to(state[0].dtype)
        change = self.bounded(change)  # (*batch, D)
        limit = self.training_range.limit_motion
        after = self.state_delta.integrate(*state, change, limit)
        return self.sleep.apply_sleep(state, self.training_range.stop_joints(*after))

    def bounded(self, change: Tensor) -> Tensor:
        """Denormalised change ``(*batch, D)``, within the range of the data."""
        change = self.training_range.clamp_target(change)
        return self.normalize.denormalize(TARGET, change)

    def step(
        self,
        state: State,
        drive: Tensor,
        terrain: Tensor | None,
        network_step: Callable[[Tensor], Tensor],
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The next ``qpos`` and ``qvel``, and the features, for `ood_score`.

        Args:
            state: ``qpos (*batch, nq)`` and ``qvel (*batch, nv)``.
            drive: ``(*batch, num_actuated + num_ctrl)``, see `drive_of`.
            terrain: ``(*batch, terrain.size)``; None for the scene's own ground.
            network_step: ``(*batch, token_size) -> (*batch, D)``: keeps the history.
        """
        encoded = self.encode(*state, drive, terrain)
        after = self.decode(state, encoded, network_step(encoded.token))
        return *after, encoded.features

    def ood_score(self, features: Tensor) -> Tensor:
        """Out-of-distribution score ``(*batch,)``, see `OODScore`."""
        return self.ood(features, self.training_range.excess(features))

    def copy_for(self, scene: Scene) -> "NeRD":
        """An uninitialised model of the same configuration for another scene."""
        return NeRD(scene, self.scene_features.config, self.config)

    def with_terrain(self, scene: Scene) -> "NeRD":
        """The same weights for the same robot over another ground.

        Raises:
            ValueError: another robot, a ground that is described by other features,
                other parameters than the model is told, or features or targets that were
                given to the model.
        """
        own = type(self.scene_features), type(self.state_delta)
        if own != (SceneFeatures, StateDelta):  # they hold the ground that they are of
            names = " and ".join(x.__name__ for x in own)
            raise ValueError(f"expected SceneFeatures and StateDelta, got {names}")
        if scene.robot_hash != self.scene.robot_hash:
            raise ValueError(
                f"expected the robot of scene '{self.scene.name}' over another ground, "
                f"got another robot in '{scene.name}'"
            )
        expect_told(ranges_of(self.scene_features.variation), scene.variation)
        with torch.random.fork_rng(devices=[]):  # weights are drawn, then replaced
            model = self.copy_for(scene)
        sizes = self.scene_features.contact.sizes
        other = model.scene_features.contact.sizes
        if sizes != other:
            raise ValueError(
                f"expected a ground with the features {dict(sizes)} that the model was "
                f"trained on, got one with {dict(other)}"
            )
        model.network = copy.deepcopy(self.network)  # in the precisions that it has
        model.load_state_dict(self.state_dict())
        model.reference_ratio = self.reference_ratio
        return model.to(self.device).train(self.training)

    def _apply(self, fn: Callable, recurse: bool = True) -> "NeRD":
        """Move everything, but cast only the network: constants stay float64.

        bfloat16 is for the inner matrices alone, see `modules.linear`.
        """

        def move(x: Tensor) -> Tensor:
            return x.to(fn(x).device)

        for part in self.children():
            part._apply(fn if part is self.network else move, recurse)
        return self

    @property
    def dtype(self) -> torch.dtype:
        """What the network is given and gives; its inner matrices may be bfloat16."""
        return next(self.network.parameters()).dtype

    @property
    def device(self) -> torch.device:
        """Where it computes."""
        return next(self.network.parameters()).device
