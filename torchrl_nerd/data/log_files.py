"""Recorded logs of any robot: read from npz or CSV, checked, kept as a data set.

| npz array; CSV columns | shape | unit, frame |
|---|---|---|
| ``qpos``; qpos_0, qpos_1, ... | (N, nq) | MuJoCo's, as everywhere |
| ``qvel``; qvel_0, ... | (N, nv) | the same; may be left out |
| ``joint_torque``; joint_torque_0, ... | (N, motors) | N m or N until the next state; 0 |
| ``terrain``; terrain_0, ... | (N, terrain.size) | where the ground varies; see `Terrain` |
| ``trajectory_offsets``; - | (T + 1,) | trajectory i is rows ``o[i]:o[i + 1]`` |
| ``trajectory``; trajectory, toss | (N,) | in place of offsets: a number per trajectory |
| ``time``; time | (N,) | s; frames of the scene's control step where left out |

A single free body may have, in place of ``qpos`` and ``qvel``:

| npz array; CSV columns | shape | unit, frame |
|---|---|---|
| ``position``; x, y, z | (N, 3) | m, world, z up, of the body's frame |
| ``quaternion_wxyz``; qw, qx, qy, qz | (N, 4) | from body to world |
| ``linear_velocity``; vx, vy, vz | (N, 3) | m/s, world; may be left out |
| ``angular_velocity``; wx, wy, wz | (N, 3) | rad/s, body; may be left out |

`data.physics_checks` checks units and frames, which no file states.
"""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np
import torch
from torch import Tensor

from torchrl_nerd import __version__
from torchrl_nerd.data.generate import CARD
from torchrl_nerd.data.physics_checks import check_log
from torchrl_nerd.data.recorded import (
    TORQUE,
    Recording,
    complete,
    is_free_body,
    split_trajectories,
)
from torchrl_nerd.data.store import (
    chunk_path,
    write_chunk,
)
from torchrl_nerd.files import writable_folder, write_json
from torchrl_nerd.keys import QPOS, QVEL, TERRAIN
from torchrl_nerd.scenes import Scene

FREE_BODY = {
    "position": ("x", "y", "z"),
    "quaternion_wxyz": ("qw", "qx", "qy", "qz"),
    "linear_velocity": ("vx", "vy", "vz"),
    "angular_velocity": ("wx", "wy", "wz"),
}
ARRAYS = (
    *(QPOS, QVEL, TORQUE, TERRAIN, *FREE_BODY),
    *("trajectory_offsets", "trajectory", "time"),
)
LARGEST_LOG = 2**30  # bytes of an npz file, unpacked


def read_log(path: Path, scene: Scene) -> Recording:
    """A log from an npz or CSV file, as it was written; nothing in it is unpickled.

    Raises:
        ValueError: in one sentence, a file, array or shape that is not as expected.
    """
    if not path.is_file():
        raise ValueError(f"expected a log in {path}, found no file")
    arrays = _read_csv(path) if path.suffix == ".csv" else _read_npz(path)
    for name, array in arrays.items():
        if array.ndim == 0 or array.dtype.kind not in "fiu":
            raise ValueError(
                f"expected an array of numbers in '{name}' of {path}, got {array.dtype} "
                f"of shape {array.shape}"
            )
    is_pose = is_free_body(scene) and QPOS not in arrays
    terrain = scene.terrain if scene.terrain and scene.terrain.is_per_row else None
    needed = ("position", "quaternion_wxyz") if is_pose else (QPOS,)
    for name in (*needed, *((TERRAIN,) if terrain else ())):
        if name not in arrays:
            found = ", ".join(sorted(arrays)) or "nothing"
            raise ValueError(f"expected '{name}' in {path}, found {found}")
    count, nv = len(arrays[needed[0]]), scene.model.nv
    sizes = {QPOS: scene.model.nq, QVEL: nv, TORQUE: len(scene.actuated)}
    sizes |= {name: len(columns) for name, columns in FREE_BODY.items()}
    if terrain:
        sizes[TERRAIN] = terrain.size
    shapes: dict[str, tuple[int, ...]] = {k: (count, v) for k, v in sizes.items()}
    shapes |= {"time": (count,), "trajectory": (count,)}
    tensors = {}
    for name, shape in shapes.items():
        array = arrays.get(name)
        if array is None:
            continue
        if array.shape != shape:
            raise ValueError(
                f"expected '{name}' of shape {shape} in {path}, got {array.shape}"
            )
        if not np.isfinite(array).all():
            raise ValueError(
                f"expected finite numbers in '{name}' of {path}, got others"
            )
        tensors[name] = torch.as_tensor(array, dtype=torch.float64)
    none = torch.full((count, nv), torch.nan, dtype=torch.float64)
    if is_pose:
        parts = [tensors.get(name, none[:, :3]) for name in FREE_BODY]
        tensors |= {QPOS: torch.cat(parts[:2], 1), QVEL: torch.cat(parts[2:], 1)}
    log = Recording(
        tensors[QPOS],
        tensors.get(QVEL, none),
        tensors.get(TORQUE, none.new_zeros(count, len(scene.actuated))),
        _offsets(arrays, count, path),
        scene.control_step,
        tensors.get("time"),
        tensors.get(TERRAIN),
    )
    if log.time is None:
        return log
    return replace(log, frame=float(log.time.diff()[log.inside[1:]].median()))


def _offsets(arrays: dict[str, np.ndarray], count: int, path: Path) -> Tensor:
    offsets = np.array([0, count])
    if "trajectory" in arrays:
        edges = np.flatnonzero(np.diff(arrays["trajectory"])) + 1
        offsets = np.array([0, *edges, count])
    offsets = arrays.get("trajectory_offsets", offsets)
    is_order = offsets.ndim == 1 and len(offsets) > 1 and offsets.dtype.kind in "iu"
    whole = offsets.astype(np.int64) if is_order else np.zeros(2, np.int64)
    if whole[0] != 0 or whole[-1] != count or np.diff(whole).min() < 2:
        raise ValueError(
            f"expected trajectory_offsets in {path} to rise from 0 to {count} by at "
            "least 2, got others"
        )
    return torch.as_tensor(whole)


def _read_npz(path: Path) -> dict[str, np.ndarray]:
    try:
        with ZipFile(path) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
        if size > LARGEST_LOG:
            raise ValueError(f"{size} bytes when unpacked")
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in ARRAYS if name in file.files}
    except Exception as error:  # numpy and zipfile raise a dozen kinds at odd bytes
        said = str(error).splitlines() or [type(error).__name__]
        raise ValueError(
            f"expected an npz file in {path}, got another: {said[0]}"
        ) from None


def _read_csv(path: Path) -> dict[str, np.ndarray]:
    try:
        table: Any = np.genfromtxt(
            path, delimiter=",", names=True, dtype=np.float64, ndmin=1
        )
    except (ValueError, IndexError) as error:
        said = " ".join(str(error).split())
        raise ValueError(f"expected a CSV table in {path}: {said}") from None
    names = table.dtype.names or ()
    columns = dict(FREE_BODY)
    for array in (QPOS, QVEL, TORQUE, TERRAIN):
        numbers = [re.fullmatch(rf"{array}_(\d+)", name) for name in names]
        found = sorted(int(number[1]) for number in numbers if number)
        if found:
            columns[array] = tuple(f"{array}_{number}" for number in found)
    arrays = {
        array: np.stack([table[column] for column in its], -1)
        for array, its in columns.items()
        if set(its) <= set(names)
    }
    aliases = {"time": "time", "toss": "trajectory", "trajectory": "trajectory"}
    return arrays | {aliases[name]: table[name] for name in names if name in aliases}


def load_recording(path: Path, scene: Scene) -> tuple[Recording, dict[str, Tensor]]:
    """States of a file that passes its checks, and the trajectories of each split.

    Raises:
        ValueError: in one sentence, a file that cannot be read or the check that failed.
    """
    log = read_log(path, scene)
    check_log(log, scene)
    return complete(log, scene), split_trajectories(len(log))


def write_recording(path: Path, scene: Scene, folder: Path) -> dict[str, Any]:
    """Write a data set ``[transitions]`` with the keys of every other; returns its card.

    Beside them: ``("collector", "traj_ids")``, the trajectory, and ``part``: 0 to train
    on, 1 to validate, 2 to test.

    Raises:
        ValueError: as `load_recording`; the folder cannot be written or holds other data.
    """
    log = read_log(path, scene)
    checks, split = check_log(log, scene), split_trajectories(len(log))
    if (folder / CARD).exists():
        raise ValueError(f"{folder} already holds data: choose another folder")
    data = complete(log, scene).transitions()
    part = torch.empty(len(log), dtype=torch.int8)
    for number, members in enumerate(split.values()):
        part[members] = number
    data["part"] = part[data["collector", "traj_ids"]]
    write_chunk(data, chunk_path(writable_folder(folder), 0))
    card = {
        "scene": scene.name,
        "scene_hash": scene.hash,
        "source": path.name,
        "trajectories": len(log),
        "transitions": len(data),
        "split": {name: members.tolist() for name, members in split.items()},
        "checks": [str(check) for check in checks],
        "torchrl_nerd": __version__,
    }
    write_json(folder / CARD, card)
    return card
