"""Equal training of every variant: the package's trainer with another model in it."""

from collections.abc import Mapping
from pathlib import Path

import torch
from tensordict import TensorDict

from torchrl_nerd.configs import TrainConfig
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.robots import Source
from torchrl_nerd.scenes import Scene
from torchrl_nerd.training.optimizers import make_adamw
from torchrl_nerd.training.symmetry import Symmetry
from torchrl_nerd.training.trainer import Trainer

from .variants import Variant

TOKENS = 1024  # per update
LENGTH = 32  # of a sequence: more than the longest history tried
LR = 0.03  # of Muon; larger than for a whole training, since this one is short
ADAMW_LR_WITH_MUON = 0.003  # of AdamW beside it
LR_ALONE = 0.02  # of AdamW where all is its own; both are the best on validation starts
LOSS_EPS: Mapping[str, float] = {"double_pendulum": 1.0, "ant": 0.02}
"""Of the loss, as for each scene's learned model (see `make model-SCENE-mlp`)."""


class VariantTrainer(Trainer):
    """A `Trainer` of one variant, which neither validates nor saves.

    Args:
        variant: what is trained.
        scene: the robot.
        data: transitions, ``[trajectories, steps]``.
        source: of the scene.
        folder: of the log.
        updates: how many.
        seed: of weights and batches.
    """

    def __init__(
        self,
        variant: Variant,
        scene: Scene,
        data: TensorDict,
        source: Source,
        folder: Path,
        updates: int,
        seed: int,
    ) -> None:
        self.variant = variant
        length = variant.window or LENGTH
        config = TrainConfig(
            steps=updates,
            rollout_steps=0,
            batch_size=TOKENS // length,
            sequence_length=length,
            lr=LR,
            adamw_lr=ADAMW_LR_WITH_MUON if variant.has_muon else LR_ALONE,
            loss_eps=LOSS_EPS[scene.name],
            seed=seed,
        )
        super().__init__(scene, data, source, config, folder, quiet=True, logger="csv")

    def make_model(self, data: TensorDict, symmetry: Symmetry | None) -> NeRD:
        """The variant's."""
        return self.variant.build(self.scene, data)

    def make_optimizers(self) -> dict[str, torch.optim.Optimizer]:
        """The package's, or AdamW alone."""
        if self.variant.has_muon:
            return super().make_optimizers()
        weights = list(self.model.network.parameters())
        return {"adamw": make_adamw(weights, self.config.adamw_lr, self.device)}

    def validate(self) -> dict[str, float]:
        """Nothing: no choice hangs on it."""
        return {}

    def save(self) -> None:
        """Nothing: no checkpoint can hold a variant."""
