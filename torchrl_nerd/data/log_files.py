"""Recorded logs of any robot: read from npz or CSV, checked, kept as a data set.

docs/howto/logs.md names the arrays and columns, with shapes, units and frames, which
`data.physics_checks` checks: no file states them.
"""

from collections.abc import Collection
from dataclasses import replace
from difflib import get_close_matches
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
    Recording,
    complete,
    is_free_body,
    split_trajectories,
)
from torchrl_nerd.data.store import chunk_path, write_chunk
from torchrl_nerd.files import writable_folder, write_json
from torchrl_nerd.keys import CTRL, JOINT_TORQUE, QPOS, QVEL, TERRAIN
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.commands import num_ctrl

TORQUE, CONTROL = JOINT_TORQUE[-1], CTRL[-1]
FREE_BODY = {
    "position": ("x", "y", "z"),
    "quaternion_wxyz": ("qw", "qx", "qy", "qz"),
    "linear_velocity": ("vx", "vy", "vz"),
    "angular_velocity": ("wx", "wy", "wz"),
}
ARRAYS = (
    *(QPOS, QVEL, TORQUE, CONTROL, TERRAIN, *FREE_BODY),
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
    arrays = _read_csv(path) if path.suffix.lower() == ".csv" else _read_npz(path)
    for name, array in arrays.items():
        if array.ndim == 0 or array.dtype.kind not in "fiu":
            raise ValueError(
                f"expected an array of numbers in '{name}' of {path}, got {array.dtype} "
                f"of shape {array.shape}"
            )
    is_pose = is_free_body(scene) and QPOS not in arrays
    needed = ["position", "quaternion_wxyz"] if is_pose else [QPOS]
    motors, nv = len(scene.actuated), scene.model.nv
    sizes = {QPOS: scene.model.nq, QVEL: nv, TORQUE: motors}
    sizes |= {name: len(columns) for name, columns in FREE_BODY.items()}
    if scene.terrain is not None and scene.terrain.is_per_env:
        needed.append(TERRAIN)
        sizes[TERRAIN] = scene.terrain.size
    if num_ctrl(scene):
        needed.append(CONTROL)
        sizes[CONTROL] = num_ctrl(scene)
    elif CONTROL in arrays:
        raise ValueError(
            f"expected '{TORQUE}' in {path} of the motors of '{scene.name}', got "
            f"'{CONTROL}'"
        )
    for name in needed:
        if name not in arrays:
            found = ", ".join(sorted(arrays)) or "nothing"
            raise ValueError(f"expected '{name}' in {path}, found {found}")
    count = len(arrays[needed[0]])
    if count < 2:
        raise ValueError(f"expected at least 2 frames in {path}, got {count}")
    shapes = {"time": (count,), "trajectory": (count,)}
    shapes |= {name: (count, size) for name, size in sizes.items()}
    tensors = {}
    for name in (name for name in shapes if name in arrays):
        if arrays[name].shape != shapes[name]:
            raise ValueError(
                f"expected '{name}' of shape {shapes[name]} in {path}, "
                f"got {arrays[name].shape}"
            )
        tensors[name] = torch.from_numpy(arrays[name].astype(np.float64))
        bad = (~tensors[name].reshape(count, -1).isfinite()).any(1).nonzero()
        if len(bad):
            raise ValueError(
                f"expected finite numbers in '{name}' of {path}, got others in row "
                f"{int(bad[0])}"
            )
    none = torch.full((count, nv), torch.nan, dtype=torch.float64)
    if is_pose:
        parts = [tensors.get(name, none[:, :3]) for name in FREE_BODY]
        tensors |= {QPOS: torch.cat(parts[:2], 1), QVEL: torch.cat(parts[2:], 1)}
    columns = {QVEL: none, TORQUE: none.new_zeros(count, motors)}
    names = (QPOS, QVEL, TORQUE, "time", TERRAIN, CONTROL)
    columns |= {name: tensors[name] for name in names if name in tensors}
    offsets = _offsets(arrays, count, path)
    log = Recording(**columns, offsets=offsets, frame=scene.control_step)
    if log.time is None:
        return log
    return replace(log, frame=float(log.time.diff()[log.inside[1:]].median()))


def _offsets(arrays: dict[str, np.ndarray], count: int, path: Path) -> Tensor:
    offsets = np.array([0, count])
    if "trajectory" in arrays:
        numbers = arrays["trajectory"]
        offsets = np.array([0, *(np.flatnonzero(np.diff(numbers)) + 1), count])
        lengths, starts = np.diff(offsets), numbers[offsets[:-1]]
        short, (_, parts) = lengths < 2, np.unique(starts, return_counts=True)
        if short.any() or parts.max() > 1:
            row = int(offsets[:-1][short][0]) if short.any() else 0
            what = f"one of one frame in row {row}" if short.any() else "several pieces"
            raise ValueError(
                f"expected every trajectory in {path} in one piece of at least 2 frames, "
                f"got {what}"
            )
        if not np.array_equal(arrays.get("trajectory_offsets", offsets), offsets):
            raise ValueError(
                f"expected equal trajectories by 'trajectory' and 'trajectory_offsets' "
                f"in {path}, got others"
            )
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
            others = sorted(set(file.files).difference(ARRAYS))
            found = {name: file[name] for name in ARRAYS if name in file.files}
    except Exception as error:  # numpy and zipfile raise a dozen kinds at odd bytes
        said = str(error).splitlines() or [type(error).__name__]
        raise ValueError(
            f"expected an npz file in {path}, got another: {said[0]}"
        ) from None
    for name in others:
        if meant := _meant(name, found):
            raise ValueError(f"expected an array '{meant}' in {path}, got '{name}'")
    return found


def _meant(name: str, found: Collection[str], cutoff: float = 0.8) -> str | None:
    """The missing array of which a name is a misspelling; None: of none."""
    missing = set(ARRAYS).difference(found, FREE_BODY if QPOS in found else ())
    return next(iter(get_close_matches(name.lower(), missing, 1, cutoff)), None)


def _read_csv(path: Path) -> dict[str, np.ndarray]:
    try:
        how: dict[str, Any] = {"dtype": np.float64, "encoding": "utf-8-sig"}
        table: Any = np.genfromtxt(path, delimiter=",", names=True, ndmin=1, **how)
    except (ValueError, IndexError) as error:
        said = " ".join(str(error).split())
        raise ValueError(f"expected a CSV table in {path}: {said}") from None
    names: set[str] = set(table.dtype.names or ())
    with path.open(encoding="utf-8-sig") as file:
        head = [name.strip() for name in file.readline().lstrip("#").split(",")]
    if twice := next((name for name in head if head.count(name) > 1), None):
        raise ValueError(f"expected one column '{twice}' in {path}, got several")
    if "trajectory_offsets" in names:
        raise ValueError(
            f"expected a column 'trajectory' in {path}, got 'trajectory_offsets', which "
            "is an array of npz files"
        )
    columns = dict(FREE_BODY)
    for array in (QPOS, QVEL, TORQUE, CONTROL, TERRAIN):
        start = f"{array}_"
        ends = (name.removeprefix(start) for name in names if name.startswith(start))
        if count := sum(end.isdecimal() for end in ends):
            columns[array] = tuple(f"{array}_{number}" for number in range(count))
            _expect_columns(path, columns[array], names)
    if QPOS not in columns:
        for its in FREE_BODY.values():
            if not names.isdisjoint(its):
                _expect_columns(path, its, names)
    arrays = {
        array: np.stack([table[column] for column in its], -1)
        for array, its in columns.items()
        if names.issuperset(its)
    }
    others = "time", "trajectory"
    for name in sorted(names.difference(others)):
        if name.lower() in others:
            raise ValueError(
                f"expected a column '{name.lower()}' in {path}, got '{name}'"
            )
        stem, _, number = name.rpartition("_")
        meant = _meant(stem, {*arrays, *others, "trajectory_offsets"}, 0.6)
        if number.isdecimal() and meant:
            raise ValueError(f"expected columns of '{meant}' in {path}, got '{name}'")
    return arrays | {name: table[name] for name in others if name in names}


def _expect_columns(path: Path, expected: tuple[str, ...], names: set[str]) -> None:
    """Refuse an array of which some columns are missing."""
    if missing := [name for name in expected if name not in names]:
        raise ValueError(
            f"expected columns {', '.join(expected)} in {path}, got none named "
            f"{', '.join(missing)}"
        )


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
