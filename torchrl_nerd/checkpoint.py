"""Checkpoints: a folder with ``model.safetensors`` and ``card.json``; nothing is pickled.

The card says which physics the weights were trained on. Loading compares it with the
local scene and warns, in one sentence, of what differs.
"""

import os
import platform
import warnings
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

import mujoco
import torch
from tensordict.utils import NestedKey

from torchrl_nerd import __version__
from torchrl_nerd.files import folder_name, read_json, writable_folder, write_json
from torchrl_nerd.modules.baselines import GRUConfig, MLPConfig
from torchrl_nerd.modules.correction import (
    FreeConfig,
    GroundedConfig,
    ResidualConfig,
)
from torchrl_nerd.modules.free import FreeNeRD
from torchrl_nerd.modules.grounded import GroundedNeRD
from torchrl_nerd.modules.nerd import Config, NeRD
from torchrl_nerd.modules.networks import NetworkConfig
from torchrl_nerd.modules.residual import ResidualNeRD
from torchrl_nerd.modules.transformer import TransformerConfig
from torchrl_nerd.robots import load_scene
from torchrl_nerd.scenes import Scene, is_import
from torchrl_nerd.selfcheck import PREFIX as CHECK
from torchrl_nerd.selfcheck import (
    SelfCheck,
    self_check,
    stored_steps,
    warn_of_differences,
)
from torchrl_nerd.tensor_files import expect_fit, read_tensors, write_tensors
from torchrl_nerd.transforms import Stats

WEIGHTS, CARD = "model.safetensors", "card.json"
PRETRAINED = Path(__file__).parent / "pretrained"
LARGEST_SIZE = 2**14  # of any number in a network's configuration
COVERAGE = "coverage."
GAIN = {"coverage.gain"}
REST = {"coverage.still", *GAIN}
NEWEST = {"coverage.qpos_low", "coverage.qpos_high", *REST}
KINDS: dict[str, type] = {
    "transformer": TransformerConfig,
    "mlp-4x64": MLPConfig,
    "gru": GRUConfig,
    "residual-mlp": ResidualConfig,
    "free-mlp": FreeConfig,
    "grounded-mlp": GroundedConfig,
}
CORRECTED: dict[type, type[NeRD]] = {
    ResidualConfig: ResidualNeRD,
    FreeConfig: FreeNeRD,
    GroundedConfig: GroundedNeRD,
}


def make_model(
    scene: Scene,
    config: Config,
    stats: Mapping[NestedKey, Stats] | None = None,
) -> NeRD:
    """A model of that configuration whose weights are yet to be loaded or trained.

    Raises:
        ValueError: a robot that no model of that configuration is for.
    """
    return CORRECTED.get(type(config), NeRD)(scene, config, stats)


def make_card(model: NeRD, training: dict[str, Any] | None = None) -> dict[str, Any]:
    """What a checkpoint says of itself.

    Args:
        model: the weights' owner.
        training: how they were made: configuration, data, measured error curve.
    """
    scene, config = model.scene, model.config
    kind = next(name for name, cls in KINDS.items() if type(config) is cls)
    return {
        "format": 1,
        "scene": scene.name,
        "scene_hash": scene.hash,
        "reference_ratio": scene.reference_ratio,
        "control_step": scene.control_step,
        "foresees_forces": scene.foresees_forces,
        "foresees_free_motion": scene.foresees_free_motion,
        "flies": model.flight is not None,
        "network": {"kind": kind, **asdict(cast(Any, config))},
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


def save_checkpoint(model: NeRD, folder: Path, card: dict[str, Any]) -> Path:
    """Write weights, with a few steps to check them by, then card: each whole or not."""
    folder = writable_folder(folder)
    steps = stored_steps(model, _teacher(card, model.scene))
    write_tensors(folder / WEIGHTS, model.state_dict() | steps)
    write_json(folder / CARD, card)
    return folder


def load_checkpoint(folder: str | Path, scene: Scene | None = None) -> NeRD:
    """A model from a folder; warns where this machine does not repeat its steps.

    See `read_checkpoint`.
    """
    folder = Path(folder)
    model, check = read_checkpoint(folder, scene)
    if check is not None:
        warn_of_differences(check, folder)
    return model


def read_checkpoint(
    folder: Path, scene: Scene | None = None
) -> tuple[NeRD, SelfCheck | None]:
    """A model from a folder that `save_checkpoint` wrote, and its self-check.

    There is none for another scene than the card's, nor in weights of before 0.2.

    Args:
        folder: where.
        scene: the robot to use it for; the card's own scene where not given.

    Raises:
        ValueError: in one sentence, a missing, truncated or foreign file, a wrong shape,
            or weights of another robot.
    """
    if not (folder / CARD).is_file() or not (folder / WEIGHTS).is_file():
        raise ValueError(
            f"expected {WEIGHTS} and {CARD} in {folder}, found no checkpoint"
        )
    card = read_json(folder / CARD)
    names = "foresees_forces", "foresees_free_motion"
    foresight = [card.get(name) is True for name in names]  # none did before 0.2
    scene = (scene or _scene_of(card, folder)).foreseeing(*foresight)
    teacher = _teacher(card, scene)
    _compare(card, teacher, folder)
    config, tensors = _network_config(card, folder), read_tensors(folder / WEIGHTS)
    # its first weights are drawn, then replaced
    with torch.random.fork_rng(devices=[]):
        try:
            _expect_room(config, tensors)
            model = make_model(scene, config)
            if card.get("flies") is True:
                model.fly()
        except ValueError as error:
            raise ValueError(
                f"the network in {folder} cannot be built: {error}"
            ) from None
    bounds = {k: v for k, v in model.state_dict().items() if k.startswith(COVERAGE)}
    missing = bounds.keys() - tensors.keys()
    if missing in (bounds.keys(), NEWEST, REST, GAIN):  # weights of before 0.2
        tensors |= {key: bounds[key] for key in missing}
    what = f"weights in {folder}"
    weights = {k: v for k, v in tensors.items() if not k.startswith(CHECK)}
    expect_fit(weights, model.state_dict(), what, f"scene '{scene.name}'")
    model.load_state_dict(weights)
    if card.get("scene_hash") != teacher.hash:
        return model.eval(), None
    return model, self_check(model.eval(), teacher, tensors, str(folder / WEIGHTS))


def from_pretrained(name_or_folder: str | Path, scene: Scene | None = None) -> NeRD:
    """A shipped model by the name of its scene, or one of your own by its folder.

    Raises:
        ValueError: neither a shipped model nor a folder with a checkpoint.
    """
    asked = str(name_or_folder)
    name = folder_name(asked) if is_import(asked) else asked
    if name in shipped_models():
        return load_checkpoint(PRETRAINED / name, scene)
    if os.path.isdir(asked):  # False, too, for what no path can be
        return load_checkpoint(Path(name_or_folder), scene)
    if is_import(asked):
        raise ValueError(
            f"no model of '{asked}' is shipped: make one with `nerd data {asked}` and "
            f"`nerd train {asked}`, then give its folder, runs/{name}/best"
        )
    names = ", ".join(shipped_models())
    raise ValueError(
        f"expected a shipped model ({names}) or a checkpoint folder, got {asked!r}"
    )


def shipped_models() -> list[str]:
    """Names of the models that come with the package."""
    return sorted(path.parent.name for path in PRETRAINED.glob(f"*/{CARD}"))


def _scene_of(card: dict[str, Any], folder: Path) -> Scene:
    name = card.get("scene")
    if not isinstance(name, str):
        raise ValueError(f"the card in {folder} names an unknown scene: {name!r}")
    try:
        return load_scene(name)
    except ValueError as error:
        raise ValueError(f"the scene of the card in {folder}: {error}") from None


def _teacher(card: dict[str, Any], scene: Scene) -> Scene:
    """The scene as the model's data were stepped."""
    return scene.reference if card.get("reference_ratio", 1) != 1 else scene


def _network_config(
    card: dict[str, Any], folder: Path
) -> NetworkConfig | ResidualConfig:
    found = card.get("network")
    network = dict(found) if isinstance(found, dict) else {}
    kind = network.pop("kind", None)
    sizes = network.values()
    try:
        if not all(type(size) is int and 0 < size <= LARGEST_SIZE for size in sizes):
            raise TypeError
        return KINDS[str(kind)](**network)
    except (KeyError, TypeError):
        raise ValueError(
            f"the card in {folder} has a network this version cannot build: "
            f"{card.get('network')!r}"
        ) from None


def _expect_room(
    config: NetworkConfig | ResidualConfig, tensors: dict[str, torch.Tensor]
) -> None:
    """Refuse a card's network that its weights cannot fill, before memory is asked for."""
    depth = getattr(config, "depth", 0) or getattr(config, "layers", 0)
    if depth <= len(tensors):
        with torch.device("meta"):
            needed = sum(weight.numel() for weight in config.build(1, 1).parameters())
        if needed <= sum(value.numel() for value in tensors.values()):
            return
    raise ValueError(f"its weights are too few for {config}")


def _compare(card: dict[str, Any], scene: Scene, folder: Path) -> None:
    """Refuse another robot; warn of other physics or another MuJoCo.

    Tasks of the dm_control suite may share a robot: the same physics by another name.
    """
    if scene.name != card.get("scene") and scene.hash != card.get("scene_hash"):
        raise ValueError(
            f"the checkpoint in {folder} is for robot '{card.get('scene')}', "
            f"expected '{scene.name}'"
        )
    local = {
        "control_step": scene.control_step,
        "scene_hash": scene.hash,
        "mujoco": mujoco.__version__.rsplit(".", 1)[0],
    }
    version = str(_versions(card).get("mujoco"))
    stored = {**card, "mujoco": version.rsplit(".", 1)[0]}
    differing = [
        f"{key} is {stored.get(key)} there and {value} here"
        for key, value in local.items()
        if stored.get(key) != value
    ]
    if differing:
        warnings.warn(
            f"the checkpoint in {folder} was made for other physics: "
            + ", ".join(differing),
            stacklevel=3,
        )


def _versions(card: dict[str, Any]) -> dict[str, Any]:
    found = card.get("versions")
    return found if isinstance(found, dict) else {}
