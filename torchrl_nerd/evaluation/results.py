"""The one schema of files in ``results/``: how numbers were made, and the numbers."""

import platform
import re
import shlex
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch

from torchrl_nerd import __version__
from torchrl_nerd.files import read_json, write_json

KEYS = {
    "command": str,  # line that makes the file again
    "commit": str,  # of the code
    "machine": dict,  # processor and versions
    "seed": int | list | None,  # or seeds; None: nothing is random
    "results": dict | list,  # what was measured
}

Results = dict[str, Any] | list[dict[str, Any]]


def make_record(
    results: Results,
    seed: int | list[int] | None = None,
    command: str | None = None,
    device: str = "cpu",
) -> dict[str, Any]:
    """The record of `KEYS`; ``command`` is the running script's by default."""
    return {
        "command": command or script_command(),
        "commit": commit(),
        "machine": machine(device),
        "seed": seed,
        "results": results,
    }


def write_results(
    path: Path, results: Results, seed: int | list[int] | None = None, **about: Any
) -> None:
    """Write the record of `make_record`, which has the same arguments, as JSON."""
    write_json(path, make_record(results, seed, **about))


def script_command() -> str:
    """The command line of the running script or module, from the repository's root."""
    script, words = Path(sys.argv[0]), sys.argv[1:]
    if "--json" in words:
        at = words.index("--json")
        del words[at : at + 2]
    words = [word for word in words if not word.startswith("--json=")]
    module = getattr(sys.modules["__main__"], "__spec__", None)  # of python -m
    if module is not None and module.origin == sys.argv[0]:
        what = ["-m", module.name.removesuffix(".__main__")]
    else:
        root, path = Path(__file__).parents[2], script.resolve()
        inside = path.is_relative_to(root)
        what = [str(path.relative_to(root) if inside else Path(*path.parts[-2:]))]
    return shlex.join(["python", *what, *words])


def read_results(path: Path) -> dict[str, Any]:
    """The record in a file.

    Raises:
        ValueError: no JSON there, or a key that is missing or of another type.
    """
    record = read_json(path)
    for key, kind in KEYS.items():
        if key not in record:
            expected = ", ".join(KEYS)
            raise ValueError(f"{path}: expected keys {expected}, found no '{key}'")
        if not isinstance(record[key], kind):
            found = type(record[key]).__name__
            raise ValueError(f"{path}: expected '{key}' of type {kind}, got {found}")
    return record


def commit() -> str:
    """Commit of the code, ``-dirty`` where files differ; its version if it has none."""
    here = Path(__file__)
    # an installed package may lie in the folder of another project's repository
    is_tracked = ["git", "ls-files", "--error-unmatch", here.name]
    words = ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        for command in (is_tracked, words):
            done = subprocess.run(
                command, cwd=here.parent, check=True, capture_output=True, text=True
            )
    except (OSError, subprocess.CalledProcessError):  # no git, or no repository of it
        return __version__
    return done.stdout.strip()


def machine(device: str = "cpu") -> dict[str, Any]:
    """Processor, threads, device and versions."""
    where, information = torch.device(device), Path("/proc/cpuinfo")
    said = information.read_text() if information.exists() else ""
    model = re.search(r"^model name\s*:\s*(.*)$", said, re.M)
    is_gpu = where.type == "cuda"
    return {
        "processor": model[1] if model else platform.processor() or platform.machine(),
        "threads": torch.get_num_threads(),
        "device": torch.cuda.get_device_name(where) if is_gpu else where.type,
        **versions("torch", "torchrl", "mujoco"),
    }


def versions(*packages: str) -> dict[str, str]:
    """Of Python and of packages."""
    found = {"python": platform.python_version()}
    for name in packages:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found
