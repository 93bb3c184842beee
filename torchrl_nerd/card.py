"""The card of a checkpoint: kind, network, step, physics and training, as JSON."""

import platform
from dataclasses import asdict
from pathlib import Path
from typing import Any

import mujoco
import torch

from torchrl_nerd import __version__
from torchrl_nerd.configs import (
    FeatureConfig,
    FreeBodyConfig,
    PenaltyContactConfig,
    StepConfig,
    UnconstrainedConfig,
)
from torchrl_nerd.dynamics import Model
from torchrl_nerd.modules.hybrid import HybridNeRD
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.modules.networks import GRUConfig, MLPConfig, NetworkConfig
from torchrl_nerd.modules.transformer import TransformerConfig
from torchrl_nerd.settings import SettingError

FORMAT = 2
MAX_SIZE = 2**14  # of any number in a configuration
NETWORK_KINDS: dict[str, type] = {
    "transformer": TransformerConfig,
    "mlp": MLPConfig,
    "gru": GRUConfig,
}
STEP_KINDS: dict[str, type] = {
    "unconstrained": UnconstrainedConfig,
    "penalty-contact": PenaltyContactConfig,
    "free-body": FreeBodyConfig,
}


def make_card(model: Model, training: dict[str, Any] | None = None) -> dict[str, Any]:
    """What a checkpoint says of itself.

    Args:
        model: the weights' owner.
        training: how they were made: configuration, data, measured error curve.
    """
    scene = model.scene
    card: dict[str, Any] = {
        "format": FORMAT,
        "kind": model.kind,
        "scene": scene.name,
        "scene_hash": scene.hash,
        "reference_ratio": scene.reference_ratio,
        "control_step": scene.control_step,
        "network": None,
        "step": None,
    }
    step = model if not isinstance(model, NeRD) else None
    if isinstance(model, NeRD):
        card["network"] = _described(NETWORK_KINDS, model.config)
        card["features"] = asdict(model.scene_features.config)
        card["reference_ratio"] = model.reference_ratio
    if isinstance(model, HybridNeRD):
        step = model.analytic_step
    if step is not None:
        card["step"] = _described(STEP_KINDS, step.config)
    return card | {
        "training_ranges": scene.sampling.ranges(),
        "versions": {
            "torchrl_nerd": __version__,
            "mujoco": mujoco.__version__,
            "torch": torch.__version__,
            "python": platform.python_version(),
        },
        "licence": "MIT",
        **(training or {}),
    }


def network_config_of(card: dict[str, Any], folder: Path) -> NetworkConfig:
    """The network that a card describes.

    Raises:
        ValueError: it describes none that this version can build.
    """
    return _config(NETWORK_KINDS, card.get("network"), "network", folder)


def step_config_of(card: dict[str, Any], folder: Path) -> StepConfig:
    """The analytic step that a card describes.

    Raises:
        ValueError: it describes none that this version can build.
    """
    return _config(STEP_KINDS, card.get("step"), "step", folder)


def features_of(card: dict[str, Any], folder: Path) -> FeatureConfig:
    """The predictions among the features of a card's network.

    Raises:
        ValueError: it names none that this version can build.
    """
    found = card.get("features")
    fields = {"kind": "features", **found} if isinstance(found, dict) else None
    return _config({"features": FeatureConfig}, fields, "features", folder)


def _described(kinds: dict[str, type], config: Any) -> dict[str, Any]:
    """A configuration with the name of its kind."""
    kind = next(name for name, cls in kinds.items() if type(config) is cls)
    return {"kind": kind, **asdict(config)}


def _config(kinds: dict[str, type], found: Any, what: str, folder: Path) -> Any:
    """The inverse of `_described`, of a card that may say anything."""
    fields = dict(found) if isinstance(found, dict) else {}
    kind = fields.pop("kind", None)
    try:
        default = asdict(kinds[str(kind)]())
        for name, value in fields.items():
            fits = type(value) is type(default[name])
            if not fits or (type(value) is int and not 0 < value <= MAX_SIZE):
                raise TypeError(name)
        return kinds[str(kind)](**fields)
    except (KeyError, TypeError, SettingError):
        raise ValueError(
            f"the card in {folder} has a {what} this version cannot build: {found!r}"
        ) from None
