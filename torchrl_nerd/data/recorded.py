"""Recorded tosses from file to states and, checked, to a data set on disk."""

from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_nerd import __version__
from torchrl_nerd.data.cube_tosses import Tosses, make_tosses, read_log, split_tosses
from torchrl_nerd.data.generate import CARD
from torchrl_nerd.data.physics_checks import check_log
from torchrl_nerd.data.store import (
    chunk_path,
    expect_finite,
    read_chunk,
    write_chunk,
)
from torchrl_nerd.files import writable_folder, write_json
from torchrl_nerd.scenes import Scene

REAL = {"cube": "cube_real", "cube_real": "cube_real"}
"""Scenes that recorded tosses are of, by the names that commands take."""

SHIPPED = "cube_tosses"
"""The shipped model that was fine-tuned on them."""


def load_tosses(path: Path, scene: Scene) -> tuple[Tosses, dict[str, Tensor]]:
    """States of a file that fits physics, and the numbers ``(n,)`` of its parts' tosses.

    Raises:
        ValueError: in one sentence, a file that cannot be read or the check that failed.
    """
    log = read_log(path)
    check_log(log, scene)
    tosses = make_tosses(log, scene)
    return tosses, split_tosses(len(tosses))


def write_tosses(path: Path, scene: Scene, folder: Path) -> dict[str, Any]:
    """Write a data set ``[transitions]`` with the keys of every other; returns its card.

    Beside them: ``("collector", "traj_ids")``, the toss, and ``part``, 0 for training,
    1 for validation, 2 for test.

    Raises:
        ValueError: as `load_tosses`; the folder cannot be written or holds other data.
    """
    log = read_log(path)
    checks = check_log(log, scene)
    tosses = make_tosses(log, scene)
    if (folder / CARD).exists():
        raise ValueError(f"{folder} already holds data: choose another folder")
    data = tosses.transitions()
    part = torch.empty(len(tosses), dtype=torch.int8)
    split = split_tosses(len(tosses))
    for number, members in enumerate(split.values()):
        part[members] = number
    data["part"] = part[data["collector", "traj_ids"]]
    write_chunk(data, chunk_path(writable_folder(folder), 0))
    card = {
        "scene": scene.name,
        "scene_hash": scene.hash,
        "source": path.name,
        "trajectories": len(tosses),
        "transitions": len(data),
        "split": {name: members.tolist() for name, members in split.items()},
        "checks": [str(check) for check in checks],
        "torchrl_nerd": __version__,
    }
    write_json(folder / CARD, card)
    return card


def read_transitions(folder: Path) -> TensorDict:
    """The data set that `write_tosses` wrote, memory-mapped, ``[transitions]``.

    Raises:
        ValueError: in one sentence, what is missing or broken.
    """
    data = read_chunk(chunk_path(folder, 0), 1)
    expect_finite(data, folder)
    return data
