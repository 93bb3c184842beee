"""The card of a checkpoint: kind, network, step, physics and training, as JSON."""

import platform
from dataclasses import asdict
from pathlib import Path
from typing import Any

import mujoco
import torch

from torchrl_nerd import __version__, configs
from torchrl_nerd.dynamics import Model
from torchrl_nerd.modules.hybrid import HybridNeRD
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.modules.networks import GRUConfig, MLPConfig
from torchrl_nerd.modules.transformer import TransformerConfig
from torchrl_nerd.scenes.variation import ranges_of
from torchrl_nerd.settings import SettingError

FORMAT = 2
MAX_SIZE = 2**14  # of any number in a configuration
KINDS: dict[str, dict[str, type]] = {
    "network": {"transformer": TransformerConfig, "mlp": MLPConfig, "gru": GRUConfig},
    "step": {
        "unconstrained": configs.UnconstrainedConfig,
        "penalty-contact": configs.PenaltyContactConfig,
        "free-body": configs.FreeBodyConfig,
    },
    # one kind, which cards do not name
    "features": {"features": configs.FeatureConfig},
}
"""Configurations by the part of the model and the name of their kind in a card."""


def make_card(model: Model, training: dict[str, Any] | None = None) -> dict[str, Any]:
    """What a checkpoint says of itself; ``training``: how its weights were made."""
    scene = model.scene
    if isinstance(model, NeRD) and model.reference_ratio > 1:
        scene = scene.reference
    card: dict[str, Any] = {
        "format": FORMAT,
        "kind": model.kind,
        "scene": scene.name,
        "scene_hash": scene.hash,
        "reference_ratio": scene.reference_ratio,
        "control_step": scene.control_step,
        "variation": ranges_of(scene.variation),
        "network": None,
        "step": None,
    }
    step = model.analytic_step if isinstance(model, HybridNeRD) else model
    if isinstance(model, NeRD):
        card["network"] = _described("network", model.config)
        card["features"] = asdict(model.scene_features.config)
    if not isinstance(step, NeRD):
        card["step"] = _described("step", step.config)
    if isinstance(model, HybridNeRD):
        card["is_gated"] = model.is_gated
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


def _described(what: str, config: Any) -> dict[str, Any]:
    """A configuration with the name of its kind."""
    kind = next(name for name, cls in KINDS[what].items() if type(config) is cls)
    return {"kind": kind, **asdict(config)}


def config_of(card: dict[str, Any], what: str, folder: Path) -> Any:
    """A card's ``network``, ``step`` or ``features``; a ValueError if none can be built."""
    found = card.get(what)
    try:
        if not isinstance(found, dict):
            raise TypeError
        fields = dict(found)
        cls = KINDS[what][str(fields.pop("kind", what))]
        default = asdict(cls())
        for name, value in fields.items():
            fits = type(value) is type(default[name])
            if not fits or (type(value) is int and not 0 < value <= MAX_SIZE):
                raise TypeError
        return cls(**fields)
    except (KeyError, TypeError, SettingError):
        raise ValueError(
            f"the card in {folder} has a {what} this version cannot build: {found!r}"
        ) from None
