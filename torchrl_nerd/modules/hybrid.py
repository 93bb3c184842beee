"""Hybrid dynamics: an analytic step plus a learned residual."""

from collections.abc import Mapping
from typing import ClassVar

import torch
from tensordict.utils import NestedKey
from torch import Tensor, nn

from torchrl_nerd.analytic import AnalyticStep
from torchrl_nerd.configs import FeatureConfig
from torchrl_nerd.modules.nerd import TARGET, Encoded, NeRD
from torchrl_nerd.modules.networks import NetworkConfig
from torchrl_nerd.scenes.scene import Scene
from torchrl_nerd.transforms import Stats

GATE_SCALE = 1.0  # rms of the normalised velocity defect at which the gate is open
TINY = 1e-24
MAX_CHANGE = 1e6  # normalised; the analytic change of absurd torques overflows


class HybridNeRD(NeRD):
    """An analytic step whose error a network corrects.

        change = analytic change + gate * network(features, defect, analytic change)
        gate   = min(rms(defect) / GATE_SCALE, 1)

    The defect is the step's own error estimate, see `StepResult`, in standard deviations of
    the velocity change. Where it is zero, as in free fall without rotation, the network has
    no influence. The analytic change stays float64. It may exceed all changes in the
    data, so the sum is bounded by the largest speeds alone.

    ``step`` is one of the scene or of its reference solver; all else as for `NeRD`. The
    network's last layer is zero at first. A model that is not ``is_gated`` has a gate of 1.
    By default that is one of a varied scene: the step's estimate of its own error does not
    know how another robot moves.
    """

    kind: ClassVar[str] = "hybrid"

    def __init__(
        self,
        scene: Scene,
        step: AnalyticStep,
        features: FeatureConfig,
        network: NetworkConfig,
        stats: Mapping[NestedKey, Stats] | None = None,
        is_gated: bool | None = None,
    ) -> None:
        if features.parameters:
            raise ValueError(
                "expected a learned model to be told parameters, got a hybrid"
            )
        self._num_defects = step.num_defects  # the base class asks for `token_size`
        super().__init__(scene, features, network, stats)
        self.analytic_step = step
        self.is_gated = scene.variation is None if is_gated is None else is_gated
        last = [m for m in self.network.head.modules() if isinstance(m, nn.Linear)][-1]
        for weight in last.parameters():
            nn.init.zeros_(weight)
        if hasattr(self.network, "products"):  # a GRU has none
            self.network.products.silence()

    @property
    def token_size(self) -> int:
        """Width of the features, the defect and the analytic change."""
        return self.scene_features.size + self._num_defects + self.state_delta.size

    def encode(
        self, qpos: Tensor, qvel: Tensor, drive: Tensor, terrain: Tensor | None
    ) -> Encoded:
        """See `NeRD.encode`; the base is the step's change, the gate follows its defect."""
        features = self.features(qpos, qvel, drive, terrain)
        result = self.analytic_step(qpos, qvel, drive, terrain)  # no servos: a torque
        change = self.state_delta.delta(qpos, qvel, result.qpos, result.qvel)
        change = _finite(self.normalize.normalize(TARGET, change))
        scale = self.normalize.std(TARGET)[: self.scene.layout.nv]
        defect = result.velocity_defect  # (*batch, nv) or several of them
        defect = _finite(defect / scale.repeat(defect.shape[-1] // len(scale)))
        squared = defect.square().mean(-1, keepdim=True)
        rms = (squared + TINY).sqrt() - TINY**0.5  # finite slope at rest
        token = self.training_range.clamp_features(features)
        token = torch.cat((token, defect, change), -1).to(self.dtype)
        gate = (rms / GATE_SCALE).clamp_max(1.0)
        gate = gate if self.is_gated else torch.ones_like(gate)
        return Encoded(features, token, change, gate)

    def bounded(self, change: Tensor) -> Tensor:
        """Denormalised change, bounded by the largest speeds of the data."""
        change = self.normalize.denormalize(TARGET, change)
        return self.training_range.clamp_change(change, self.scene.control_step)

    def copy_for(self, scene: Scene) -> "HybridNeRD":
        """See `NeRD.copy_for`."""
        step = self.analytic_step.with_terrain(scene)
        how = self.scene_features.config, self.config
        return HybridNeRD(scene, step, *how, is_gated=self.is_gated)


def _finite(x: Tensor) -> Tensor:
    """``x`` bounded, zero where it is not a number: the features carry the fault."""
    return x.nan_to_num(0.0).clamp(-MAX_CHANGE, MAX_CHANGE)
