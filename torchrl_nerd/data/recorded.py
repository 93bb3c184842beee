"""Recorded trajectories of a robot: completed, split, cut into windows, kept as data."""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import torch
from tensordict import TensorDict
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_nerd.geometry.manifold import differentiate_pos, integrate_pos
from torchrl_nerd.keys import (
    CTRL,
    JOINT_TORQUE,
    NEXT_QPOS,
    NEXT_QVEL,
    QPOS,
    QVEL,
    TERRAIN,
)
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.controllers import clipped_ctrl

SPLIT_SEED, TRAIN_SHARE, VALIDATION_SHARE = 0, 380 / 510, 65 / 510
FEWEST = 6  # trajectories of which no split is empty
CLEAR = 0.005  # m between the lowest contact point and the ground: free flight
FLIGHT = 8  # frames at the start of a trajectory in which free fall is measured


@dataclass(frozen=True, eq=False)
class Recording:
    """Recorded trajectories, one after the other, float64."""

    qpos: Tensor  # (N, nq)
    qvel: Tensor  # (N, nv); NaN where not recorded, until `complete`
    joint_torque: Tensor  # (N, num_actuated), N m or N, held until the next state;
    # a servo's is that of the frame's own time
    offsets: Tensor  # (T + 1,): trajectory i is frames offsets[i]:offsets[i + 1]
    frame: float  # time between two states, s
    time: Tensor | None = None  # time stamps (N,), s
    terrain: Tensor | None = None  # the ground (N, terrain.size), where it varies
    ctrl: Tensor | None = None  # of servos (N, num_ctrl), held until the next state

    def __len__(self) -> int:
        return len(self.offsets) - 1

    @property
    def columns(self) -> dict[NestedKey, Tensor]:
        """States and what drives them, ``(N, *)``, by the keys of every other data set."""
        found = {QPOS: self.qpos, QVEL: self.qvel, JOINT_TORQUE: self.joint_torque}
        found |= {TERRAIN: self.terrain, CTRL: self.ctrl}
        return {key: value for key, value in found.items() if value is not None}

    @property
    def inside(self) -> Tensor:
        """Which frames follow one of the same trajectory, bool ``(N,)``."""
        inside = torch.ones(len(self.qpos), dtype=torch.bool)
        inside[self.offsets[:-1]] = False
        return inside

    def select(self, numbers: Tensor) -> "Recording":
        """Some of the trajectories by their ``numbers (n,)``, in that order."""
        frames = self.starts(1, numbers)
        counts = self.offsets.diff()[numbers]
        ends = torch.cat((counts.new_zeros(1), counts.cumsum(0)))
        names = "qpos", "qvel", "joint_torque", "terrain", "ctrl"
        found = {name: getattr(self, name) for name in names}
        kept = {name: x[frames] for name, x in found.items() if x is not None}
        return replace(self, **kept, offsets=ends, time=None)

    def starts(self, states: int, numbers: Tensor | None = None) -> Tensor:
        """Indices ``(windows,)`` of frames where ``states`` consecutive states begin.

        Of the trajectories with these ``numbers (n,)``, or of all.

        Raises:
            ValueError: none is long enough, or a split of the log is empty.
        """
        if numbers is not None and not len(numbers) and len(self) < FEWEST:
            splits = split_trajectories(len(self)).items()
            empty = " and ".join(name for name, members in splits if not len(members))
            raise ValueError(
                f"expected a trajectory in every split, got a log of {len(self)} with none "
                f"for {empty}: cut it into at least {FEWEST} trajectories"
            )
        found, bounds = [torch.zeros(0, dtype=torch.long)], self.trajectories
        for i in range(len(self)) if numbers is None else numbers.tolist():
            first, end = bounds[i].start, bounds[i].stop
            found.append(torch.arange(first, max(first, end - states + 1)))
        starts = torch.cat(found)
        if len(starts) == 0:
            raise ValueError(
                f"expected a trajectory of at least {states} states, got none"
            )
        return starts

    @property
    def trajectories(self) -> list[slice]:
        """The frames of each."""
        bounds = self.offsets.tolist()
        return [slice(first, end) for first, end in pairwise(bounds)]

    def trajectory_of(self, frames: Tensor) -> Tensor:
        """Number of the trajectory of each of ``frames (n,)``, ``(n,)``."""
        return torch.searchsorted(self.offsets, frames, right=True) - 1

    def windows(self, starts: Tensor, states: int) -> TensorDict:
        """Consecutive states and what drives them ``[windows, states]``."""
        frames = starts[:, None] + torch.arange(states)  # (windows, states)
        columns = {key: value[frames] for key, value in self.columns.items()}
        return TensorDict(columns, [*frames.shape])

    def transitions(self) -> TensorDict:
        """The keys of every other data set ``[transitions]``, and trajectory numbers.

        TorchRL's `SliceSampler` cuts trajectories of unequal lengths by
        ``("collector", "traj_ids")``.
        """
        after = self.inside.nonzero()[:, 0]
        now = {key: column[after - 1] for key, column in self.columns.items()}
        moved = {NEXT_QPOS: self.qpos[after], NEXT_QVEL: self.qvel[after]}
        number = {("collector", "traj_ids"): self.trajectory_of(after)}
        return TensorDict(now | moved | number, [len(after)])


def is_free_body(scene: Scene) -> bool:
    """Whether the robot is one free body without motors."""
    is_single = scene.base.is_floating and scene.model.nv == 6
    return is_single and not scene.controller.num_actions


def complete(log: Recording, scene: Scene) -> Recording:
    """States of a checked log: unit quaternions, and velocities that it lacks.

    Velocities are estimated from positions as `estimate_velocities` does. A velocity that
    is a mean over the frame before lags its state: of a free body in flight the median lag
    is measured, and what gravity adds in that time is added. A trajectory's first estimate
    is the mean over the frame after it, and leads. The torque of servos follows from their
    controls.
    """
    layout = scene.layout
    qpos = integrate_pos(layout, log.qpos, torch.zeros_like(log.qvel))
    log = replace(log, qpos=qpos)
    qvel = torch.where(log.qvel.isnan(), estimate_velocities(log, scene), log.qvel)
    if is_free_body(scene):
        is_airborne = (scene.clearances(qpos, log.terrain) > CLEAR).all(-1)
        steady = is_airborne & log.inside
        if steady.any():
            mean = backward_differences(log, scene)[:, 2]
            half = 0.5 * log.frame * float(free_fall(log)[2])
            qvel[is_airborne, 2] += (mean + half - qvel[:, 2])[steady].median()
            first = log.offsets[:-1]  # estimated from the frame after it
            is_estimated = log.qvel[first, 2].isnan() & is_airborne[first]
            leads = first[is_estimated & is_airborne[first + 1]]
            qvel[leads, 2] = mean[leads] - half
    log = replace(log, qvel=qvel)
    if scene.servos is None or log.ctrl is None:
        return log
    ctrl = clipped_ctrl(scene.model, log.ctrl)
    return replace(log, ctrl=ctrl, joint_torque=scene.servos.torque(ctrl, qpos, qvel))


def estimate_velocities(log: Recording, scene: Scene) -> Tensor:
    """``qvel (N, nv)`` from positions: `backward_differences`, a median of three each."""
    qvel = backward_differences(log, scene)
    smooth = torch.stack((qvel.roll(1, 0), qvel, qvel.roll(-1, 0))).median(0).values
    ends = torch.cat((log.offsets[:-1], log.offsets[1:] - 1))
    smooth[ends] = qvel[ends]
    return smooth


def backward_differences(log: Recording, scene: Scene) -> Tensor:
    """``qvel (N, nv)`` over the frame before; a trajectory's first is its second's."""
    step = differentiate_pos(scene.layout, log.qpos[:-1], log.qpos[1:])
    qvel = torch.cat((step[:1], step)) / log.frame
    first = log.offsets[:-1]
    qvel[first] = qvel[first + 1]
    return qvel


def free_fall(log: Recording) -> Tensor:
    """Median over trajectories of a free body's first acceleration, ``(3,)``, m/s^2.

    Raises:
        ValueError: no trajectory of at least 4 frames.
    """
    found = []
    for frames in log.trajectories:
        path = log.qpos[frames, :3][:FLIGHT]  # (frames, 3)
        if len(path) < 4:
            continue
        t = log.frame * torch.arange(len(path), dtype=torch.float64)
        basis = torch.stack((torch.ones_like(t), t, 0.5 * t * t), -1)
        found.append(torch.linalg.lstsq(basis, path).solution[2])
    if not found:
        raise ValueError("expected a trajectory of at least 4 frames, got none")
    return torch.stack(found).median(0).values


def split_trajectories(count: int) -> dict[str, Tensor]:
    """Numbers ``(n,)`` of the trajectories to train on, to choose by and to test with.

    Of the 510 published tosses of a cube: 380, 65 and 65, by the recommended seed.
    """
    order = torch.from_numpy(np.random.default_rng(SPLIT_SEED).permutation(count))
    train, validation = round(TRAIN_SHARE * count), round(VALIDATION_SHARE * count)
    parts = order.tensor_split((train, train + validation))
    return dict(zip(("train", "validation", "test"), parts, strict=True))
