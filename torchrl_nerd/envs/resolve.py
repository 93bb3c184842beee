"""One name for every dynamics: what `make_env` and every command take."""

import os
from pathlib import Path
from typing import Any

import torch

from torchrl_nerd.analytic import STEPS, make_step
from torchrl_nerd.checkpoint import from_pretrained, shipped_models
from torchrl_nerd.dynamics import Dynamics, Model, dynamics_of
from torchrl_nerd.envs.ground_truth import ENGINES, GROUND_TRUTH
from torchrl_nerd.scenes import Scene, is_import

KINDS = ("nerd", "hybrid", "analytic")
"""Names of the models of a scene, beside those of engines and of shipped models."""


def resolve_model(name: str | Path, scene: Scene) -> Model:
    """The model of that name for a scene.

    Args:
        name: ``"nerd"`` (the scene's learned model), ``"hybrid"``, ``"analytic"``, the
            name of an analytic step in `STEPS`, of a shipped model, or a checkpoint folder.
        scene: the robot.

    Raises:
        ValueError: in one sentence, no such model, or a scene that it cannot step.
    """
    asked = str(name)
    if asked == "analytic":
        return make_step(scene)
    if asked in STEPS:
        return make_step(scene, STEPS[asked])
    if asked == "nerd":
        names = shipped_models()
        for known in (scene.name, f"{scene.name}-mlp"):
            if known in names:
                return from_pretrained(known, scene)
        if is_import(scene.name):
            return from_pretrained(scene.name, scene)
        raise ValueError(
            f"no learned model of '{scene.name}' is shipped: train one with `nerd train "
            f"{scene.name}` and give its folder, or use dynamics 'analytic'"
        )
    if asked == "hybrid":
        if f"{scene.name}-hybrid" not in shipped_models():
            raise ValueError(
                f"no hybrid model of '{scene.name}' is shipped: expected one whose network "
                "lowers the error of its analytic step; use dynamics 'analytic'"
            )
        return from_pretrained(f"{scene.name}-hybrid", scene)
    if asked in shipped_models() or os.path.isdir(asked):
        return from_pretrained(name, scene)
    engines = ", ".join(GROUND_TRUTH)
    raise ValueError(
        f"unknown dynamics '{asked}', expected {', '.join(KINDS)}, {engines}, an analytic "
        f"step ({', '.join(STEPS)}), a shipped model ({', '.join(shipped_models())}) or a "
        "checkpoint folder"
    )


def make_dynamics(
    name: str | Path,
    scene: Scene,
    device: torch.device | str = "cpu",
    compile: bool = False,
    differentiable: bool = False,
    **how: Any,
) -> Dynamics:
    """The dynamics of that name for a scene.

    Args:
        name: an engine (``"mujoco"``, ``"dm_control"``, ``"mujoco_warp"``), or a model, see
            `resolve_model`.
        scene: the robot.
        device: of models and of MuJoCo Warp; the other engines run on the CPU.
        compile: run a model through `torch.compile`.
        differentiable: record gradients through a model's step.
        how: further arguments of `NeRDDynamics`.

    Raises:
        ValueError: in one sentence, no such dynamics, or gradients of an engine.
        ModuleNotFoundError: MuJoCo Warp is asked for and not installed.
    """
    if name in ENGINES:
        if differentiable:
            raise ValueError(
                f"expected learned, hybrid or analytic dynamics for gradients, got '{name}'"
            )
        return ENGINES[str(name)](scene, device)
    model = resolve_model(name, scene)
    return dynamics_of(model.to(device), compile, differentiable, **how)
