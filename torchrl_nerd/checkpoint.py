"""Checkpoints: a folder with ``model.safetensors`` and ``card.json``; nothing is pickled.

The card names the kind of the model (learned, hybrid or analytic), its network and step,
and the physics that it was made for. Loading compares that with the local scene and warns,
in one sentence, of what differs.
"""

import os
import warnings
from glob import glob
from pathlib import Path
from typing import Any

import mujoco
import torch

from torchrl_nerd.analytic import STEPS, fitting_steps, make_step
from torchrl_nerd.card import FORMAT, config_of
from torchrl_nerd.card import make_card as make_card
from torchrl_nerd.dynamics import ENGINES, Model
from torchrl_nerd.files import folder_name, read_json, writable_folder, write_json
from torchrl_nerd.modules.hybrid import HybridNeRD
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.modules.networks import NetworkConfig
from torchrl_nerd.robots import load_scene
from torchrl_nerd.robots.registry import MODELS, PRETRAINED, RESERVED
from torchrl_nerd.scenes import Scene, is_import
from torchrl_nerd.scenes.variation import expect_told
from torchrl_nerd.selfcheck import PREFIX as CHECK
from torchrl_nerd.selfcheck import (
    SelfCheck,
    self_check,
    stored_steps,
    warn_of_differences,
)
from torchrl_nerd.settings import did_you_mean
from torchrl_nerd.tensor_files import expect_fit, read_tensors, write_tensors

WEIGHTS, CARD = "model.safetensors", "card.json"
KINDS = ("nerd", "hybrid", "analytic")
"""Names of the models of a scene, beside those of engines and of shipped models."""


def save_checkpoint(model: Model, folder: str | Path, card: dict[str, Any]) -> Path:
    """Write weights, with a few steps to check them by, then card: each whole or not."""
    folder = writable_folder(Path(folder))
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
    if (got := card.get("format")) != FORMAT:
        raise ValueError(f"expected a card of format {FORMAT} in {folder}, got {got!r}")
    scene = scene or _scene_of(card, folder)
    solver_scene = _solver_scene(card, scene)
    _compare(card, solver_scene, folder)
    tensors = read_tensors(folder / WEIGHTS)
    model = _build(card, scene, solver_scene, tensors, folder)
    if isinstance(model, NeRD):
        model.reference_ratio = solver_scene.reference_ratio
        if model.scene_features.config.parameters:
            expect_told(card.get("variation"), scene.variation)
    weights = {k: v for k, v in tensors.items() if not k.startswith(CHECK)}
    about = f"weights in {folder}", f"scene '{scene.name}'"
    expect_fit(weights, model.state_dict(), *about)
    model.load_state_dict(weights)
    model.eval()
    if card.get("scene_hash") != solver_scene.hash:
        return model, None
    return model, self_check(model, solver_scene, tensors, str(folder / WEIGHTS))


@torch.inference_mode(False)
def from_pretrained(name_or_folder: str | Path, scene: Scene | None = None) -> Model:
    """The model of that name, which `make_env` and every command take.

    Args:
        name_or_folder: a shipped model, a scene (``"cube_real"`` stands for its learned
            model ``"cube_real-mlp"``) or a checkpoint folder. For a given scene also
            ``"nerd"`` (its learned model), ``"hybrid"``, ``"analytic"``, or an analytic
            step in `STEPS`.
        scene: the robot; by default that of the model.

    Raises:
        ValueError: in one sentence, no such model, or a scene that it cannot step.
    """
    if not isinstance(name_or_folder, str | Path):
        raise ValueError(f"expected dynamics of {_known()}, got {name_or_folder!r}")
    if not isinstance(scene, Scene | None):
        raise ValueError(f"expected a Scene beside '{name_or_folder}', got {scene!r}")
    found, given = model_name(name_or_folder, scene), str(name_or_folder)
    if scene is not None and (found == "analytic" or given in STEPS):
        return make_step(scene, STEPS.get(found))
    if found in shipped_models():
        return load_checkpoint(model_folder(found), scene)
    if found not in KINDS and os.path.isdir(found):  # False for what no path can be
        return load_checkpoint(Path(found), scene)
    if found in ENGINES:
        raise ValueError(f"expected a model, got the engine '{found}'")
    if scene is None and (found in KINDS or found in STEPS):
        how = f"from_pretrained('{found}', load_scene('ant'))"
        raise ValueError(f"expected a scene beside '{found}', such as {how}, got none")
    own = () if scene is None else (*KINDS, f"{scene.name}-hybrid")
    asked = scene.name if scene is not None and found in own else found
    if asked != found or is_import(found):
        raise ValueError(_not_shipped(asked, scene if "hybrid" in found else None))
    if Path(found).name != found:
        raise ValueError(_no_folder(Path(found)))
    known = *RESERVED, *STEPS, *shipped_models()
    meant = did_you_mean("nerd" if found == "learned" else found, known)
    raise ValueError(f"unknown dynamics {found!r}{meant}, expected {_known()}")


def _no_folder(folder: Path) -> str:
    """That a checkpoint's folder does not exist, and which there are in its place."""
    place, cards = folder.parent.parent, list[str]()
    if os.path.isdir(place):  # False, too, for what no path can be
        for pattern in (f"*/{CARD}", f"*/*/{CARD}"):
            cards += sorted(glob(pattern, root_dir=place))
    there = ", ".join(str((place / card).parent) for card in cards[:5])
    found = f", but checkpoints in {there}" if there else ""
    return f"expected a checkpoint folder, found no folder {folder}{found}"


def _not_shipped(name: str, hybrid_of: Scene | None) -> str:
    """That no model has this name, and how to make one; a hybrid where a scene is given."""
    how, folder = f"nerd train {name}", f"runs/{folder_name(name)}"
    what = f"no learned model of '{name}' is shipped: make one"
    steps, reason = ([], "") if hybrid_of is None else fitting_steps(hybrid_of)
    if steps:
        what = f"no hybrid model of '{name}' is shipped: make one, STEP being "
        what += " or ".join(steps) + ","
        how, folder = f"{how} --kind hybrid --step STEP", f"{folder}-hybrid"
    elif reason:
        what = f"no hybrid model of '{name}' is possible, since no analytic step fits "
        what += f"({reason}): make a learned one"
    return (
        f"{what} with `nerd data {name}` and `{how}`, and give its folder, such as "
        f"{folder}/best"
    )


def model_name(name: str | Path, scene: Scene | None = None) -> str:
    """The model that a name stands for: of a cube ``"cube"`` for ``"nerd"``.

    What stands for nothing else, or for nothing at all, is returned as it is.
    """
    asked = given = str(name)
    shipped = shipped_models()
    if scene is not None:
        # a folder called "ant" is what "ant" names, but never what "nerd" stands for
        asked = {"nerd": scene.name, "hybrid": f"{scene.name}-hybrid"}.get(given, given)
    if asked in shipped:
        return asked
    is_folder = asked == given and os.path.isdir(given)
    is_learned = f"{asked}-mlp" in shipped and not is_folder
    return f"{asked}-mlp" if is_learned else given


def _known() -> str:
    """All that ``dynamics=`` takes."""
    parts = (*KINDS, *ENGINES), STEPS, shipped_models()
    names, steps, shipped = map(", ".join, parts)
    steps, shipped = f"an analytic step ({steps})", f"a shipped model ({shipped})"
    return f"{names}, {steps}, {shipped} or a checkpoint folder"


def shipped_models(scene: Scene | None = None) -> list[str]:
    """Names of the models that come with the package, or with a robot of a user.

    All, or those of a scene.
    """
    own = {name for name, folder in MODELS.items() if (Path(folder) / CARD).is_file()}
    names = sorted({path.parent.name for path in PRETRAINED.glob(f"*/{CARD}")} | own)
    return [x for x in names if scene is None or shipped_card(x)["scene"] == scene.name]


def shipped_card(name: str) -> dict[str, Any]:
    """The card of a shipped model."""
    return read_json(model_folder(name) / CARD)


def model_folder(name: str) -> Path:
    """Where a shipped model is."""
    return Path(MODELS.get(name, PRETRAINED / name))


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
                is_gated = card.get("is_gated", True) is not False
                return HybridNeRD(scene, step, features, network, is_gated=is_gated)
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
        scene, ranges = load_scene(name), card.get("variation")
        return scene.vary(ranges) if ranges else scene
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
        said = f"the checkpoint in {folder} was made for other physics: "
        warnings.warn(said + ", ".join(differing), stacklevel=3)
