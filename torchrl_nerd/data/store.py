"""Memory-mapped TensorDicts: read without trust in what their files say of themselves.

The layout is that of ``TensorDict.memmap``. Its own loader would unpickle what a file
asks it to, and lengthens a file that is too short; this one maps plain tensors of exactly
their size and nothing else.
"""

import os
import re
from math import prod
from pathlib import Path
from typing import Any

import torch
from tensordict import MemoryMappedTensor, TensorDict, TensorDictBase
from torch import Tensor

from torchrl_nerd.files import read_json
from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.scenes import Scene

META = "meta.json"
ABOUT = ("shape", "device", "_type")  # entries that are no tensors
DEEPEST = 4  # folders in folders
DTYPES = {
    str(dtype): dtype
    for dtype in (torch.float64, torch.float32, torch.int64, torch.int8, torch.bool)
}


def create_store(example: TensorDictBase, folder: Path) -> TensorDict:
    """A memory-mapped TensorDict like an expanded example, with its disk space reserved.

    Raises:
        ValueError: it cannot be written, or the disk is too small for it.
    """
    try:
        store = example.memmap_like(str(folder))
        for path in folder.rglob("*.memmap"):
            with open(path, "rb+") as file:  # else a full disk would kill the process
                os.posix_fallocate(file.fileno(), 0, path.stat().st_size)
    except (OSError, RuntimeError) as error:
        said = getattr(error, "strerror", None) or str(error).splitlines()[0]
        raise ValueError(f"the data cannot be written to {folder}: {said}") from None
    return store


def read_store(folder: Path, depth: int = 0) -> TensorDict:
    """The memory-mapped TensorDict in a folder.

    Raises:
        ValueError: in one sentence, something missing, foreign or of another size.
    """
    path = folder / META
    if depth > DEEPEST or not path.is_file():
        raise ValueError(f"expected stored tensors in {folder}, found none")
    meta = read_json(path)
    shape = _shape(meta.get("shape"), path)
    found = {}
    for name, entry in meta.items():
        if name in ABOUT:
            continue
        if not re.fullmatch(r"\w{1,64}", name) or not isinstance(entry, dict):
            raise ValueError(f"expected tensors by name in {path}, got {name!r}")
        is_folder = entry.get("type") == "TensorDict"
        part = read_store(folder / name, depth + 1) if is_folder else None
        found[name] = _map(folder, name, entry) if part is None else part
        if found[name].shape[: len(shape)] != shape:
            raise ValueError(
                f"expected {name!r} of shape {tuple(shape)} and more in {path}, "
                f"got {tuple(found[name].shape)}"
            )
    return TensorDict(found, batch_size=shape)


def expect_layout(data: TensorDictBase, scene: Scene, steps: int, folder: Path) -> None:
    """Refuse trajectories ``[*, steps]`` without the scene's keys, in its sizes.

    Raises:
        ValueError: naming the first key that is missing or of another shape.
    """
    now = {QPOS: scene.layout.nq, QVEL: scene.layout.nv}
    after = {**now, "joint_torque": len(scene.actuated)}
    sizes = {**now, **{("next", key): size for key, size in after.items()}}
    for key, size in sizes.items():
        value, shape = data.get(key, None), (len(data), steps, size)
        found = value is not None and (tuple(value.shape), value.dtype)
        if found != (shape, torch.float64):
            raise ValueError(
                f"expected {key!r} of shape {shape}, float64, in {folder}, "
                f"got {found or 'none'}"
            )


def expect_finite(data: TensorDictBase, folder: Path) -> None:
    """Refuse data with NaN or infinity.

    Raises:
        ValueError: naming the key.
    """
    for key, value in data.items(True, True):
        if not value.isfinite().all():
            name = key if isinstance(key, str) else "/".join(key)
            raise ValueError(
                f"expected finite numbers in {folder}, got others in '{name}'"
            )


def _shape(found: Any, path: Path) -> torch.Size:
    sizes: list[Any] = found if isinstance(found, list) else [None]
    if not all(type(size) is int and 0 <= size < 2**40 for size in sizes):
        raise ValueError(f"expected a shape in {path}, got {found!r}")
    return torch.Size(sizes)


def _map(folder: Path, name: str, entry: dict[str, Any]) -> Tensor:
    dtype = DTYPES.get(str(entry.get("dtype")))
    if dtype is None:
        raise ValueError(
            f"expected '{name}' of a type such as torch.float64 in {folder / META}, "
            f"got {entry.get('dtype')!r}"
        )
    shape, path = _shape(entry.get("shape"), folder / META), folder / f"{name}.memmap"
    expected = prod(shape) * dtype.itemsize
    if not expected:
        return torch.empty(shape, dtype=dtype)
    size = path.stat().st_size if path.is_file() else None
    if size != expected:
        raise ValueError(f"expected {expected} bytes in {path}, found {size or 'none'}")
    return MemoryMappedTensor.from_filename(path, dtype, shape)
