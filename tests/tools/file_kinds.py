"""Every kind of file that the package reads: how a sound one is made, how it is loaded."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Generator, Tensor

from torchrl_nerd.checkpoint import (
    from_pretrained,
    load_checkpoint,
    make_card,
    save_checkpoint,
)
from torchrl_nerd.configs import NO_PREDICTIONS, DataConfig, TrainConfig
from torchrl_nerd.data import generate as generation
from torchrl_nerd.data.generate import CARD, generate, load_data, simulate
from torchrl_nerd.data.log_files import (
    FREE_BODY,
    load_recording,
    read_log,
    write_recording,
)
from torchrl_nerd.data.store import chunk_path, expect_finite, read_chunk
from torchrl_nerd.evaluation.policy import Policy, load_policy, save_policy
from torchrl_nerd.files import folder_name
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.modules.networks import NETWORKS
from torchrl_nerd.robots import load_scene
from torchrl_nerd.training.log import TrainingLog
from torchrl_nerd.training.trainer import Trainer

Found = dict[str, Tensor]
"""What a loader found: tensors by name, all of which must be finite."""

EXCERPT = Path(__file__).parents[1] / "data" / "tosses_excerpt.npz"
SCENE, CUBE = "cartpole", "cube_real"
DATA = DataConfig(trajectories=6, steps=4)
CHUNK = 2  # trajectories, in place of the package's own chunk
TRAIN = TrainConfig(
    network="mlp-4x64",
    steps=2,
    rollout_steps=0,
    batch_size=2,
    sequence_length=2,
    save_every=2,
)


@dataclass(frozen=True)
class Kind:
    """A kind of file.

    | field | meaning |
    |---|---|
    | ``make`` | writes a sound sample into an empty folder |
    | ``load`` | reads it through the package |
    | ``same_shapes`` | whatever loads must have the sample's names and shapes |
    """

    make: Callable[[Path], object]
    load: Callable[[Path], Found]
    same_shapes: bool = True


def _make_checkpoint(folder: Path) -> None:
    model = NeRD(load_scene(SCENE), NO_PREDICTIONS, NETWORKS["transformer-2x64"])
    save_checkpoint(model, folder, make_card(model))


def _load_checkpoint(folder: Path) -> Found:
    return dict(load_checkpoint(folder).state_dict())


def _make_data(folder: Path) -> None:
    generate(load_scene(SCENE), DATA, folder, quiet=True)


def _load_data(folder: Path) -> Found:
    data = load_data(load_scene(SCENE), folder)
    return {str(k): v for k, v in data.items(True, True)}


def _make_unfinished(folder: Path) -> None:
    _make_data(folder)
    card = json.loads((folder / CARD).read_text())
    card |= {"chunks_done": 1, "trajectories": CHUNK, "dropped": 0}
    (folder / CARD).write_text(json.dumps(card))


def _finish_data(folder: Path) -> Found:
    generation.CHUNK = CHUNK
    _make_data(folder)
    return _load_data(folder)


def _make_recorded(folder: Path) -> None:
    write_recording(EXCERPT, load_scene(CUBE), folder)


def _load_recorded(folder: Path) -> Found:
    path = chunk_path(folder, 0)
    data = read_chunk(path, 1)
    expect_finite(data, path)
    return {str(k): v for k, v in data.items(True, True)}


def _trainer(folder: Path) -> Trainer:
    scene = load_scene(SCENE)
    data = simulate(scene, 8, 4, Generator().manual_seed(0))
    return Trainer(scene, data, scene, TRAIN, folder, horizons=(2,), quiet=True)


def _make_training(folder: Path) -> None:
    _trainer(folder).run()
    for extra in ("best", "last", "tensorboard"):  # kinds of their own, or not read
        for path in (folder / extra).glob("*"):
            path.unlink()
        (folder / extra).rmdir()


def _load_training(folder: Path) -> Found:
    if not (folder / "state.json").is_file():
        raise ValueError("nothing to resume: a new run begins")
    trainer = _trainer(folder)
    TrainingLog(folder, trainer.step)
    found = dict(trainer.model.state_dict()) | trainer.average
    for name, optimizer in trainer.optimizers.items():
        for index, state in optimizer.state_dict()["state"].items():
            found |= {f"{name}.{index}.{key}": value for key, value in state.items()}
    return found


def _make_policy(folder: Path) -> None:
    save_policy(Policy((5, 16, 1)), folder)


def _load_policy(folder: Path) -> Found:
    return dict(load_policy(folder).state_dict())


def _make_npz(folder: Path) -> None:
    (folder / "tosses.npz").write_bytes(EXCERPT.read_bytes())


def _make_csv(folder: Path) -> None:
    log = read_log(EXCERPT, load_scene(CUBE))
    toss = log.trajectory_of(torch.arange(len(log.qpos)))
    table = torch.cat((toss[:, None].double(), log.qpos), -1)
    names = ",".join(
        ("trajectory", *FREE_BODY["position"], *FREE_BODY["quaternion_wxyz"])
    )
    path = folder / "tosses.csv"
    np.savetxt(path, table.numpy(), delimiter=",", header=names, comments="")


def _load_log(name: str) -> Callable[[Path], Found]:
    def load(folder: Path) -> Found:
        found, _ = load_recording(folder / name, load_scene(CUBE))
        return {"qpos": found.qpos, "qvel": found.qvel}

    return load


def _load_name(folder: Path) -> Found:
    """A name as a user would type it, for a scene, a model, a folder."""
    if not (folder / "name").is_file():
        raise ValueError("no name was given")
    name = (folder / "name").read_bytes()[:100_000].decode(errors="replace")
    inside = (folder / folder_name(name)).resolve()
    assert inside.parent == folder.resolve(), f"{name!r} leads to {inside}"
    load_scene(name)
    return dict(from_pretrained(name).state_dict())


KINDS: dict[str, Kind] = {
    "checkpoint": Kind(_make_checkpoint, _load_checkpoint),
    "data": Kind(_make_data, _load_data, same_shapes=False),
    "data, unfinished": Kind(_make_unfinished, _finish_data, same_shapes=False),
    "data, recorded": Kind(_make_recorded, _load_recorded, same_shapes=False),
    "training": Kind(_make_training, _load_training),
    "policy": Kind(_make_policy, _load_policy),
    "tosses, npz": Kind(_make_npz, _load_log("tosses.npz"), same_shapes=False),
    "tosses, csv": Kind(_make_csv, _load_log("tosses.csv"), same_shapes=False),
    "name": Kind(
        lambda folder: (folder / "name").write_text(SCENE),
        _load_name,
        same_shapes=False,
    ),
}
