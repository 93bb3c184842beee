"""What this machine has, and whether the shipped models still do what they did."""

import os
import platform
import shutil
import time
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import torch
from tqdm import tqdm

from torchrl_nerd import __version__
from torchrl_nerd.checkpoint import PRETRAINED, read_checkpoint, shipped_models
from torchrl_nerd.evaluation.render.renderer import find_gl

PACKAGES = (
    *("torch", "torchrl", "tensordict", "mujoco", "dm-control", "gymnasium"),
    *("safetensors", "numpy", "mujoco-warp"),
)


def versions() -> dict[str, str]:
    """Of Python and of every package that matters."""
    found = {"torchrl_nerd": __version__, "python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


def machine() -> dict[str, str]:
    """Devices, threads, compiler, OpenGL."""
    cuda = "none"
    if torch.cuda.is_available():
        cuda = ", ".join(
            torch.cuda.get_device_name(index)
            for index in range(torch.cuda.device_count())
        )
    compiler = next(
        filter(
            None, map(shutil.which, (os.environ.get("CXX", "c++"), "g++", "clang++"))
        ),
        "none: compile=True runs eagerly",
    )
    return {
        "system": f"{platform.system()} {platform.machine()}",
        "processors": str(os.cpu_count()),
        "torch threads": str(torch.get_num_threads()),
        "CUDA devices": cuda,
        "C++ compiler": compiler,
        "MUJOCO_GL": os.environ.get("MUJOCO_GL", "not set"),
        "OpenGL": find_gl() or "none: nerd play cannot render",
        "display": os.environ.get("DISPLAY", "none"),
    }


def shipped_checks(quiet: bool = True) -> dict[str, dict[str, Any]]:
    """Self-check of every shipped model: differences, seconds to load, or what failed."""
    found: dict[str, dict[str, Any]] = {}
    for name in tqdm(shipped_models(), "models", leave=False, disable=quiet):
        began = time.monotonic()
        try:
            model, check = read_checkpoint(PRETRAINED / name)
        except ValueError as error:
            found[name] = {"agrees": False, "error": str(error)}
            continue
        found[name] = {
            "agrees": check is not None and check.agrees,
            "mujoco": None if check is None else check.mujoco,
            "model": None if check is None else check.model,
            "kind": model.kind,
            "seconds": round(time.monotonic() - began, 2),
        }
    return found
