"""What a machine with torch and JAX alone lacks, and how it gets there."""

import subprocess
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

NEEDED = (
    "torch",
    "numpy",
    "scipy",
    "safetensors",
    "tqdm",
    "mujoco",
    "tensordict",
    "torchrl",
)
"""What the package imports; stage c needs `FOR_MJX`, stage e `FOR_PPO` as well."""
FOR_MJX = ("jax", "mujoco-mjx")
FOR_PPO = ("tyro",)

WHEELS = {
    "mujoco": 26.7,
    "mujoco-mjx": 7.3,
    "torchrl": 3.4,
    "trimesh": 0.8,
    "tensordict": 0.6,
    "orjson": 0.1,
    "importlib-metadata": 0.0,
    "lazy-importer": 0.0,
    "hoptorch": 0.0,
    "pyvers": 0.0,
    "tyro": 0.2,
    "docstring-parser": 0.0,
    "typeguard": 0.0,
}
"""Wheels that such a machine lacks, MB each, for CPython 3.12 on Linux x86-64."""

PLATFORMS = ("manylinux_2_28", "manylinux_2_27", "manylinux_2_17", "manylinux2014")


def missing() -> dict[str, tuple[str, ...]]:
    """Packages that are not here, by what needs them."""
    found = {"all stages": NEEDED, "stage c": FOR_MJX, "stage e": FOR_PPO}
    found = {k: tuple(x for x in names if not _has(x)) for k, names in found.items()}
    return {what: names for what, names in found.items() if names}


def _has(package: str) -> bool:
    try:
        version(package)
    except PackageNotFoundError:
        return False
    return True


def pinned(package: str, constraints: Path) -> str:
    """``package==version`` as in the file of exact versions; without one the newest."""
    wanted = package.replace("-", "_")
    for line in constraints.read_text().splitlines():
        name = line.split("==")[0].replace("-", "_").lower()
        if name == wanted:
            return line.strip()
    if package == "mujoco-mjx":  # goes with its engine
        return pinned("mujoco", constraints).replace("mujoco", "mujoco-mjx", 1)
    return package


def download(folder: Path, constraints: Path) -> float:
    """Download the wheels; returns their megabytes.

    Raises:
        CalledProcessError: a wheel that the package index does not have.
    """
    tags = [word for x in PLATFORMS for word in ("--platform", f"{x}_x86_64")]
    packages = [pinned(package, constraints) for package in WHEELS]
    words = [sys.executable, "-m", "pip", "download", "-q", "--no-deps"]
    words += ["--only-binary=:all:", "--python-version", "3.12", *tags]
    words += ["--implementation", "cp", "-d", str(folder), *packages]
    subprocess.run(words, check=True)
    return sum(path.stat().st_size for path in folder.glob("*.whl")) / 1e6
