"""What this machine has, and whether the shipped models still do what they did."""

import os
import platform
import shutil
import time
from typing import Any

import torch
from tqdm import tqdm

from torchrl_nerd.checkpoint import PRETRAINED, read_checkpoint, shipped_models
from torchrl_nerd.evaluation.render.renderer import find_gl

PACKAGES = (
    *("torch", "torchrl", "tensordict", "mujoco", "dm-control", "gymnasium"),
    *("safetensors", "numpy", "mujoco-warp"),
)


def machine() -> dict[str, str]:
    """Devices, threads, compiler, OpenGL."""
    gpus = map(torch.cuda.get_device_name, range(torch.cuda.device_count()))
    compilers = (os.environ.get("CXX", "c++"), "g++", "clang++")
    compiler = next(filter(None, map(shutil.which, compilers)), None)
    return {
        "system": f"{platform.system()} {platform.machine()}",
        "processors": str(os.cpu_count()),
        "torch threads": str(torch.get_num_threads()),
        "CUDA devices": ", ".join(gpus) or "none",
        "C++ compiler": compiler or "none: compile=True runs eagerly",
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
