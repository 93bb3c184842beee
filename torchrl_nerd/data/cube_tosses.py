"""Recordings of a tossed cube, as trajectories of this package's states.

The published tosses are those of S. Pfrommer, M. Halm, M. Posa, "ContactNets" (CoRL 2020,
arXiv 2009.11193). Any log of the same layout is read, with velocities or with poses alone:

| npz array, CSV columns | shape | unit, frame |
|---|---|---|
| ``position``; x, y, z | (N, 3) | m, world, z up, of the cube's centre |
| ``quaternion_wxyz``; qw, qx, qy, qz | (N, 4) | from body to world |
| ``linear_velocity``; vx, vy, vz | (N, 3) | m/s, world; may be left out |
| ``angular_velocity``; wx, wy, wz | (N, 3) | rad/s, body; may be left out |
| ``trajectory_offsets``; toss | (T + 1,); (N,) | toss i is rows o[i] to o[i + 1] |
| ``time`` | (N,) | s; frames of 1/148 s where left out |

Nothing in a file says in which units and frames it is: `data.physics_checks` asks
physics.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_nerd.geometry.rotations import (
    quat_conjugate,
    quat_log,
    quat_multiply,
    quat_normalize,
)
from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.modules.pose_encoder import CLEAR
from torchrl_nerd.scenes import Scene

FRAME = 1.0 / 148.0  # s, of the published camera
SPLIT_SEED, TRAIN_SHARE, VALIDATION_SHARE = 0, 380 / 510, 65 / 510
MEASURED_GRAVITY = 9.61  # m/s^2 in the recordings' own metres: 2% short of 9.81
COLUMNS = {
    "position": ("x", "y", "z"),
    "quaternion_wxyz": ("qw", "qx", "qy", "qz"),
    "linear_velocity": ("vx", "vy", "vz"),
    "angular_velocity": ("wx", "wy", "wz"),
}

ARRAYS = (*COLUMNS, "trajectory_offsets", "time")
LARGEST_LOG = 2**30  # bytes of an npz file, unpacked


@dataclass(frozen=True, eq=False)
class TossLog:
    """A log as it was written.

    | field | meaning |
    |---|---|
    | ``position`` | ``(N, 3)``, m, world |
    | ``quaternion`` | ``(N, 4)``, wxyz |
    | ``linear`` | ``(N, 3)``, m/s, world, or None |
    | ``angular`` | ``(N, 3)``, rad/s, body axes, or None |
    | ``offsets`` | ``(T + 1,)``: toss i is rows ``offsets[i]:offsets[i + 1]`` |
    | ``time`` | ``(N,)``, s, or None |
    """

    position: Tensor
    quaternion: Tensor
    linear: Tensor | None
    angular: Tensor | None
    offsets: Tensor
    time: Tensor | None = None

    @property
    def frame(self) -> float:
        """Time between two frames, s."""
        if self.time is None:
            return FRAME
        return float(self.time.diff()[self.inside].median())

    @property
    def inside(self) -> Tensor:
        """Which rows are followed by one of the same toss, bool ``(N - 1,)``."""
        inside = torch.ones(len(self.position) - 1, dtype=torch.bool)
        inside[self.offsets[1:-1] - 1] = False
        return inside


@dataclass(frozen=True, eq=False)
class Tosses:
    """States of tosses one after the other; see `TossLog` for ``offsets``.

    ``qpos (N, 7)`` and ``qvel (N, 6)`` as everywhere, float64, at every ``control_step``
    of the scene.
    """

    qpos: Tensor
    qvel: Tensor
    offsets: Tensor

    def __len__(self) -> int:
        return len(self.offsets) - 1

    def select(self, numbers: Tensor) -> "Tosses":
        """Some of the tosses by their ``numbers (n,)``, in that order."""
        ends = self.offsets[1:]
        rows = [torch.arange(int(self.offsets[i]), int(ends[i])) for i in numbers]
        lengths = (ends - self.offsets[:-1])[numbers]
        offsets = torch.cat((lengths.new_zeros(1), lengths.cumsum(0)))
        index = torch.cat(rows)
        return Tosses(self.qpos[index], self.qvel[index], offsets)

    def starts(self, length: int, tosses: Tensor | None = None) -> Tensor:
        """Row of the first of every ``length`` consecutive states, ``(windows,)``."""
        which = range(len(self)) if tosses is None else tosses.tolist()
        found = []
        for i in which:
            first, end = int(self.offsets[i]), int(self.offsets[i + 1])
            found.append(torch.arange(first, max(first, end - length + 1)))
        return torch.cat(found) if found else torch.zeros(0, dtype=torch.long)

    def toss_of(self, rows: Tensor) -> Tensor:
        """Number of the toss each of ``rows (n,)`` belongs to, ``(n,)``."""
        return torch.searchsorted(self.offsets, rows, right=True) - 1

    def windows(self, starts: Tensor, length: int) -> TensorDict:
        """Consecutive states ``[windows, length]``."""
        rows = starts[:, None] + torch.arange(length)
        values = {QPOS: self.qpos[rows], QVEL: self.qvel[rows]}
        return TensorDict(values, batch_size=list(rows.shape))

    def transitions(self) -> TensorDict:
        """The keys of every other data set, ``[transitions]``, and TorchRL's toss number.

        ``("collector", "traj_ids")`` is what `SliceSampler` cuts trajectories of unequal
        lengths by.
        """
        number = self.toss_of(torch.arange(len(self.qpos)))
        now = (number[1:] == number[:-1]).nonzero()[:, 0]
        after = {QPOS: self.qpos[now + 1], QVEL: self.qvel[now + 1]}
        after["joint_torque"] = self.qpos.new_zeros(len(now), 0)
        data = {QPOS: self.qpos[now], QVEL: self.qvel[now]}
        ids = {"traj_ids": number[now]}
        parts = {"next": TensorDict(after, [len(now)]), "collector": ids}
        return TensorDict({**data, **parts}, batch_size=[len(now)])


def read_log(path: Path) -> TossLog:
    """A log from an npz or CSV file; nothing in it is unpickled.

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
    for name in ("position", "quaternion_wxyz"):
        if name not in arrays:
            found = ", ".join(sorted(arrays)) or "nothing"
            raise ValueError(f"expected '{name}' in {path}, found {found}")
    count = len(arrays["position"])
    offsets = arrays.pop("trajectory_offsets", np.array([0, count]))
    shapes: dict[str, tuple[int, ...]] = {
        name: (count, len(columns)) for name, columns in COLUMNS.items()
    }
    shapes["time"] = (count,)
    for name, shape in shapes.items():
        if name in arrays and arrays[name].shape != shape:
            raise ValueError(
                f"expected '{name}' of shape {shape} in {path}, got {arrays[name].shape}"
            )
        if name in arrays and not np.isfinite(arrays[name]).all():
            raise ValueError(
                f"expected finite numbers in '{name}' of {path}, got others"
            )
    whole = offsets.astype(np.int64) if offsets.dtype.kind in "iu" else offsets
    is_order = whole.ndim == 1 and len(whole) > 1 and (np.diff(whole) > 1).all()
    is_order = is_order and whole.dtype == np.int64
    if not is_order or whole[0] != 0 or whole[-1] != count:
        raise ValueError(
            f"expected trajectory_offsets in {path} to rise from 0 to {count} by at "
            "least 2, got others"
        )
    tensors = {
        name: torch.as_tensor(arrays[name], dtype=torch.float64)
        for name in shapes
        if name in arrays
    }
    return TossLog(
        tensors["position"],
        tensors["quaternion_wxyz"],
        tensors.get("linear_velocity"),
        tensors.get("angular_velocity"),
        torch.as_tensor(whole),
        tensors.get("time"),
    )


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
    arrays = {
        array: np.stack([table[column] for column in columns], -1)
        for array, columns in COLUMNS.items()
        if set(columns) <= set(names)
    }
    if "time" in names:
        arrays["time"] = table["time"]
    if "toss" in names:
        edges = np.flatnonzero(np.diff(table["toss"])) + 1
        arrays["trajectory_offsets"] = np.array([0, *edges, len(table)])
    return arrays


def make_tosses(log: TossLog, scene: Scene) -> Tosses:
    """States of a log; velocities that it lacks are estimated from its poses.

    A recorded velocity is the mean over the frame before: that of half a frame ago. In
    free flight half a frame of gravity is added to it.

    Args:
        log: checked.
        scene: whose corners say what flies.
    """
    linear, angular = log.linear, log.angular
    if linear is None or angular is None:
        estimated = estimate_velocities(log)
        linear = estimated[0] if linear is None else linear
        angular = estimated[1] if angular is None else angular
    qpos = torch.cat((log.position, quat_normalize(log.quaternion)), -1)
    flies = scene.clearances(qpos).amin(-1) > CLEAR
    fall = torch.zeros_like(linear)
    fall[:, 2] = -0.5 * log.frame * MEASURED_GRAVITY * flies
    return Tosses(qpos, torch.cat((linear + fall, angular), -1), log.offsets)


def estimate_velocities(log: TossLog) -> tuple[Tensor, Tensor]:
    """Linear (world) and angular (body) velocities from poses, ``(N, 3)`` each.

    As the published ones: backward differences through a median of three per axis.
    """
    linear, angular = backward_differences(log)
    smooth = []
    for x in (linear, angular):
        parts = []
        for a, b in zip(
            log.offsets[:-1].tolist(), log.offsets[1:].tolist(), strict=True
        ):
            part = x[a:b]
            around = torch.stack((part.roll(1, 0), part, part.roll(-1, 0)))
            middle = around.median(0).values
            middle[0], middle[-1] = part[0], part[-1]
            parts.append(middle)
        smooth.append(torch.cat(parts))
    return smooth[0], smooth[1]


def backward_differences(log: TossLog) -> tuple[Tensor, Tensor]:
    """Velocities over the frame before each pose; a toss's first is its second's.

    Returns:
        Linear, m/s, world, and angular, rad/s, body axes, ``(N, 3)`` each.
    """
    quat = quat_normalize(log.quaternion)
    turn = quat_log(quat_multiply(quat_conjugate(quat[:-1]), quat[1:]))
    found = []
    for step in (log.position.diff(dim=0), turn):
        speed = torch.cat((step[:1], step)) / log.frame
        first = log.offsets[:-1]
        speed[first] = speed[first + 1]
        found.append(speed)
    return found[0], found[1]


def split_tosses(count: int) -> dict[str, Tensor]:
    """Numbers ``(n,)`` of the tosses to train on, to choose by and to test with.

    Of the published 510: 380, 65 and 65, by the recommended seed.
    """
    order = torch.from_numpy(np.random.default_rng(SPLIT_SEED).permutation(count))
    train = round(TRAIN_SHARE * count)
    last = train + round(VALIDATION_SHARE * count)
    names = ("train", "validation", "test")
    parts = (order[:train], order[train:last], order[last:])
    return dict(zip(names, parts, strict=True))
