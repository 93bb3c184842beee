"""One name for every dynamics: what `make_env` and every command take."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import torch

from torchrl_nerd.analytic import STEPS, make_step
from torchrl_nerd.checkpoint import from_pretrained, shipped_models
from torchrl_nerd.dynamics import (
    DMControlDynamics,
    Dynamics,
    Model,
    MujocoDynamics,
    MujocoWarpDynamics,
)
from torchrl_nerd.scenes import Scene, is_import

Engine = Literal["mujoco", "dm_control", "mujoco_warp"]
ENGINES: dict[str, Callable[[Scene, torch.device], Dynamics]] = {
    "mujoco": lambda scene, device: MujocoDynamics(scene),
    "dm_control": lambda scene, device: DMControlDynamics(scene),
    "mujoco_warp": MujocoWarpDynamics,
}
KINDS = ("nerd", "hybrid", "analytic")
"""Names of the models of a scene, beside those of engines and of shipped models."""


def model_name(name: str | Path, scene: Scene) -> str:
    """The model that a name stands for: ``"cube-mlp"`` for ``"nerd"`` or ``"cube"``.

    What stands for nothing else, or for nothing at all, is returned as it is.
    """
    given, shipped = str(name), shipped_models()
    # a folder called "ant" is what "ant" names, but never what "nerd" stands for
    asked = {"nerd": scene.name, "hybrid": f"{scene.name}-hybrid"}.get(given, given)
    if asked in shipped:
        return asked
    is_folder = asked == given and os.path.isdir(given)
    is_learned = f"{asked}-mlp" in shipped and not is_folder
    return f"{asked}-mlp" if is_learned else given


def resolve_model(name: str | Path, scene: Scene) -> Model:
    """The model of that name for a scene.

    Args:
        name: ``"nerd"`` (the scene's learned model), ``"hybrid"``, ``"analytic"``, the
            name of an analytic step in `STEPS`, of a shipped model, or a checkpoint folder.
        scene: the robot.

    Raises:
        ValueError: in one sentence, no such model, or a scene that it cannot step.
    """
    if not isinstance(name, str | Path):
        raise ValueError(f"expected dynamics of {_known()}, got {name!r}")
    found = model_name(name, scene)
    if found == "analytic" or found in STEPS:
        return make_step(scene, STEPS.get(found))
    if found in shipped_models() or os.path.isdir(found):
        return from_pretrained(found, scene)
    if found == "nerd" and is_import(scene.name):
        return from_pretrained(scene.name, scene)  # its refusal says how to make one
    if found in KINDS:
        kind = {"nerd": "learned"}.get(found, found)
        step = " --step STEP" if found == "hybrid" else ""
        raise ValueError(
            f"no {kind} model of '{scene.name}' is shipped: train one with `nerd train "
            f"{scene.name} --kind {kind}{step}` and give its folder; `nerd explain "
            f"{scene.name}` names the analytic steps that suit it"
        )
    if found in ENGINES:
        raise ValueError(f"expected a model, got the engine '{found}'")
    raise ValueError(f"unknown dynamics '{name}', expected {_known()}")


def _known() -> str:
    """All that ``dynamics=`` takes."""
    names, steps = ", ".join((*KINDS, *ENGINES)), ", ".join(STEPS)
    shipped = ", ".join(shipped_models())
    return (
        f"{names}, an analytic step ({steps}), a shipped model ({shipped}) or a folder"
    )
