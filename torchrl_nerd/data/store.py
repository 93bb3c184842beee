"""Data sets on disk: safetensors files of trajectories, one after the other.

safetensors maps a file into memory and checks that its tensors fill it exactly, and it runs
no code from a file.
"""

from pathlib import Path

import torch
from tensordict import TensorDict, TensorDictBase

from torchrl_nerd.files import writable_folder
from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.commands import num_ctrl
from torchrl_nerd.tensor_files import read_tensors, write_tensors


def chunk_path(folder: Path, number: int) -> Path:
    """The file of a data set's chunk."""
    return folder / f"chunk-{number:05d}.safetensors"


def write_chunk(data: TensorDictBase, path: Path) -> None:
    """Write transitions with any number of batch dimensions to one file, atomically."""
    writable_folder(path.parent)
    tensors = {key: x.clone() for key, x in data.flatten_keys("/").items()}
    write_tensors(path, tensors)  # clones: safetensors refuses views of one storage


def read_chunk(path: Path, dims: int) -> TensorDict:
    """The transitions in a file, memory-mapped; ``dims`` dimensions are batch dimensions.

    Raises:
        ValueError: in one sentence, no such file, or tensors of several batch sizes.
    """
    tensors = read_tensors(path)
    sizes = {tuple(tensor.shape[:dims]) for tensor in tensors.values()}
    if len(sizes) != 1 or len(size := sizes.pop()) != dims:
        raise ValueError(f"expected transitions of one batch size in {path}")
    return TensorDict(tensors, size).unflatten_keys("/")


def expect_layout(data: TensorDictBase, scene: Scene, steps: int, path: Path) -> None:
    """Raise a ValueError unless ``[*, steps]`` has the scene's keys, in its sizes."""
    sizes = {QPOS: scene.layout.nq, QVEL: scene.layout.nv}
    sizes |= {f"next/{key}": size for key, size in sizes.items()}
    sizes |= {"next/joint_torque": len(scene.actuated)}
    if num_ctrl(scene):
        sizes |= {"next/ctrl": num_ctrl(scene)}
    if scene.terrain is not None and scene.terrain.is_per_env:
        sizes |= {"terrain": scene.terrain.size}
    if scene.variation is not None:
        sizes |= {"parameters": scene.variation.size}
    found = dict(data.flatten_keys("/").items())
    for key in sorted(sizes.keys() | found.keys()):
        value = found.get(key)
        got = value is not None and (tuple(value.shape), value.dtype)
        expected = (len(data), steps, sizes[key]) if key in sizes else None
        if got != (expected, torch.float64):
            raise ValueError(
                f"expected '{key}' of shape {expected}, float64, in {path}, "
                f"got {got or 'none'}"
            )


def expect_finite(data: TensorDictBase, path: Path) -> None:
    """Raise a ValueError with the first key that holds NaN or infinity."""
    for name, value in data.flatten_keys("/").items():
        if not value.isfinite().all():
            raise ValueError(
                f"expected finite numbers in {path}, got others in '{name}'"
            )
