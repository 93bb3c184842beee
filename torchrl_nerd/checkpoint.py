"""Checkpoints: a folder with ``model.safetensors`` and ``card.json``; nothing is pickled.

The card names the kind of the model (learned, hybrid or analytic), its network and step,
and the physics that it was made for. Loading compares that with the local scene and warns,
in one sentence, of what differs.
"""

import os
import warnings
from pathlib import Path
from typing import Any

import mujoco
import torch

from torchrl_nerd.analytic import make_step
from torchrl_nerd.card import FORMAT, config_of, make_card
from torchrl_nerd.dynamics import Model
from torchrl_nerd.files import folder_name, read_json, writable_folder, write_json
from torchrl_nerd.modules.hybrid import HybridNeRD
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.modules.networks import NetworkConfig
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

WEIGHTS, CARD = "model.safetensors", "card.json"
PRETRAINED = Path(__file__).parent / "pretrained"


def save_checkpoint(model: Model, folder: Path, card: dict[str, Any]) -> Path:
    """Write weights, with a few steps to check them by, then card: each whole or not."""
    folder = writable_folder(folder)
    steps = stored_steps(model, _solver_scene(card, model.scene))
    write_tensors(folder / WEIGHTS, model.state_dict() | steps)
    write_json(folder / CARD, card)
    return folder


def load_checkpoint(folder: str | Path, scene: Scene | None = None) -> Model:
    """`read_checkpoint`; warns where this machine does not repeat the stored steps."""
    model, check = read_checkpoint(Path(folder), scene)
    if check is not None:
        warn_of_differences(check, Path(folder))
    return model


def read_checkpoint(
    folder: Path, scene: Scene | None = None
) -> tuple[Model, SelfCheck | None]:
    """A model from a folder that `save_checkpoint` wrote, and its self-check.

    It is for ``scene``, or for the card's own where none is given. There is no self-check
    for another scene than the card's.

    Raises:
        ValueError: in one sentence, a missing, truncated or foreign file, a wrong shape,
            or weights of another robot.
    """
    if not (folder / CARD).is_file() or not (folder / WEIGHTS).is_file():
        raise ValueError(
            f"expected {WEIGHTS} and {CARD} in {folder}, found no checkpoint"
        )
    card = read_json(folder / CARD)
    if card.get("format") != FORMAT:
        raise ValueError(
            f"expected a card of format {FORMAT} in {folder}, got {card.get('format')!r}"
        )
    scene = scene or _scene_of(card, folder)
    solver_scene = _solver_scene(card, scene)
    _compare(card, solver_scene, folder)
    tensors = read_tensors(folder / WEIGHTS)
    model = _build(card, scene, solver_scene, tensors, folder)
    weights = {k: v for k, v in tensors.items() if not k.startswith(CHECK)}
    expect_fit(
        weights, model.state_dict(), f"weights in {folder}", f"scene '{scene.name}'"
    )
    model.load_state_dict(weights)
    model.eval()
    if isinstance(model, NeRD):
        model.reference_ratio = solver_scene.reference_ratio
    if card.get("scene_hash") != solver_scene.hash:
        return model, None
    return model, self_check(model, solver_scene, tensors, str(folder / WEIGHTS))


@torch.inference_mode(False)
def from_pretrained(name_or_folder: str | Path, scene: Scene | None = None) -> Model:
    """A shipped model by its name, or one of your own by its folder.

    The name of a scene stands for its learned model, ``cube`` for ``cube-mlp``, where no
    folder has that name.

    Raises:
        ValueError: neither a shipped model nor a folder with a checkpoint.
    """
    asked = str(name_or_folder)
    name = folder_name(asked) if is_import(asked) else asked
    shipped = shipped_models()
    if name in shipped:
        return load_checkpoint(PRETRAINED / name, scene)
    if os.path.isdir(asked):  # False, too, for what no path can be
        return load_checkpoint(Path(name_or_folder), scene)
    if f"{name}-mlp" in shipped:
        return load_checkpoint(PRETRAINED / f"{name}-mlp", scene)
    if is_import(asked):
        raise ValueError(
            f"no model of '{asked}' is shipped: make one with `nerd data {asked}` and "
            f"`nerd train {asked}`, then give its folder, runs/{name}/best"
        )
    raise ValueError(
        f"expected a shipped model ({', '.join(shipped)}) or a checkpoint folder, got "
        f"{asked!r}"
    )


def shipped_models(scene: Scene | None = None) -> list[str]:
    """Names of the models that come with the package, all or those of a scene."""
    names = sorted(path.parent.name for path in PRETRAINED.glob(f"*/{CARD}"))
    if scene is None:
        return names
    return [name for name in names if shipped_card(name)["scene"] == scene.name]


def shipped_card(name: str) -> dict[str, Any]:
    """The card of a shipped model."""
    return read_json(PRETRAINED / name / CARD)


def _build(
    card: dict[str, Any],
    scene: Scene,
    solver_scene: Scene,
    tensors: dict[str, torch.Tensor],
    folder: Path,
) -> Model:
    """The model that a card describes, its weights drawn at random."""
    kind = card.get("kind")
    try:
        with torch.random.fork_rng(devices=[]):
            if kind == "analytic":
                return make_step(solver_scene, config_of(card, "step", folder))
            network = config_of(card, "network", folder)
            _expect_room(network, tensors)
            features = config_of(card, "features", folder)
            if kind == "learned":
                return NeRD(scene, features, network)
            if kind == "hybrid":
                step = make_step(solver_scene, config_of(card, "step", folder))
                return HybridNeRD(scene, step, features, network)
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"the model in {folder}, kind {kind!r} with network {card.get('network')}, "
            f"cannot be built: {error}"
        ) from None
    raise ValueError(
        f"expected kind learned, hybrid or analytic in the card in {folder}, got {kind!r}"
    )


def _scene_of(card: dict[str, Any], folder: Path) -> Scene:
    name = card.get("scene")
    if not isinstance(name, str):
        raise ValueError(f"the card in {folder} names an unknown scene: {name!r}")
    try:
        return load_scene(name)
    except ValueError as error:
        raise ValueError(f"the scene of the card in {folder}: {error}") from None


def _solver_scene(card: dict[str, Any], scene: Scene) -> Scene:
    """The scene with the solver that the model was made for."""
    return scene.reference if card.get("reference_ratio", 1) != 1 else scene


def _expect_room(config: NetworkConfig, tensors: dict[str, torch.Tensor]) -> None:
    """Refuse a card's network that its weights cannot fill, before memory is allocated."""
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
        is_shipped = folder.parent == PRETRAINED
        what = f"model '{folder.name}'" if is_shipped else f"checkpoint in {folder}"
        raise ValueError(
            f"the {what} is for robot '{card.get('scene')}', expected '{scene.name}'"
        )
    local = {
        "control_step": scene.control_step,
        "scene_hash": scene.hash,
        "mujoco": mujoco.__version__.rsplit(".", 1)[0],
    }
    versions = card.get("versions")
    versions = versions if isinstance(versions, dict) else {}
    stored = {**card, "mujoco": str(versions.get("mujoco")).rsplit(".", 1)[0]}
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


__all__ = [
    "CARD",
    "PRETRAINED",
    "WEIGHTS",
    "from_pretrained",
    "load_checkpoint",
    "make_card",
    "read_checkpoint",
    "save_checkpoint",
    "shipped_card",
    "shipped_models",
]
