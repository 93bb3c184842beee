"""``nerd doctor``: what this machine has, and whether the shipped models work on it."""

import os
import platform
import shutil
import time
from dataclasses import dataclass
from typing import Any

import torch
from tqdm import tqdm

from torchrl_nerd import __version__
from torchrl_nerd.checkpoint import model_folder, read_checkpoint, shipped_models
from torchrl_nerd.cli.command import Command
from torchrl_nerd.envs.rendering import find_gl
from torchrl_nerd.evaluation.results import versions

PACKAGES = (
    *("torch", "torchrl", "tensordict", "mujoco", "dm-control", "gymnasium"),
    *("safetensors", "numpy", "mujoco-warp"),
)


@dataclass(frozen=True)
class Doctor(Command):
    """Versions, devices, and the self-check of every shipped model.

    Example: nerd doctor --json results/doctor.json
    """

    quiet: bool = False
    """Show no progress bar."""

    def run(self) -> dict[str, Any]:
        """Print what was found and return it; RuntimeError where a model differs."""
        packages = {"torchrl_nerd": __version__, **versions(*PACKAGES)}
        found = {"versions": packages, "machine": _machine()}
        for title, entries in found.items():
            print(title)
            for key, value in entries.items():
                print(f"  {key:<14}{value}")
        print("shipped models: relative difference from their stored steps")
        checks = {}
        for name in tqdm(shipped_models(), "models", leave=False, disable=self.quiet):
            check = checks[name] = _check(name)
            shown = check.get("error") or (
                f"MuJoCo {check['mujoco']:.0e}, model {check['model']:.0e}"
                f"{check['seconds']:>7} s  {'ok' if check['agrees'] else 'DIFFERS'}"
            )
            tqdm.write(f"  {name:<29} {shown}")
        results = {**found, "models": checks}
        if wrong := [name for name, check in checks.items() if not check["agrees"]]:
            self.keep(results)
            raise RuntimeError(
                f"expected every shipped model to repeat its stored steps, "
                f"{', '.join(wrong)} did not"
            )
        return results


def _machine() -> dict[str, str]:
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
        "OpenGL": find_gl() or "none: no images",
        "display": os.environ.get("DISPLAY", "none"),
    }


def _check(name: str) -> dict[str, Any]:
    """Self-check of a shipped model: differences, seconds to load, or what failed."""
    began = time.monotonic()
    try:
        model, check = read_checkpoint(model_folder(name))
    except ValueError as error:
        return {"agrees": False, "error": str(error)}
    if check is None:
        return {"agrees": False, "error": "no steps are stored"}
    seconds = round(time.monotonic() - began, 2)
    about = {"kind": model.kind, "seconds": seconds, "agrees": check.agrees}
    return {**about, "mujoco": check.mujoco, "model": check.model}
