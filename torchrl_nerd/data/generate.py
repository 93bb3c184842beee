"""Training data on disk: chunks of random trajectories, drawn on all processor cores.

A data set is a folder with a JSON card and safetensors files of trajectories
``[trajectories, steps]`` in TorchRL's layout: ``qpos``, ``qvel`` and, where the ground
varies, ``terrain``; under ``next`` the same state keys, ``joint_torque`` and, of servos,
``ctrl``.
"""

import json
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, cast

import mujoco
from tensordict import TensorDict
from torch import Generator
from tqdm import tqdm

from torchrl_nerd import __version__
from torchrl_nerd.configs import DataConfig
from torchrl_nerd.data.simulate import LARGEST, first_beyond, is_sound, simulate
from torchrl_nerd.data.store import (
    chunk_path,
    expect_finite,
    expect_layout,
    read_chunk,
    write_chunk,
)
from torchrl_nerd.files import read_json, writable_folder, write_json
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.variation import ranges_of
from torchrl_nerd.seeds import fold_in
from torchrl_nerd.settings import expect_same

CHUNK = 2048  # trajectories simulated together; a killed process loses at most these
CARD = "data.json"
MOST_DROPPED = 0.05  # share of trajectories; more, and the data are not the robot's

Draw = Callable[[int, int, Generator], TensorDict]
"""``(trajectories, steps, generator) -> [trajectories, steps]``, diverged ones too."""

Mapper = Callable[..., Iterable[TensorDict]]
"""Python's ``map`` or a parallel version of it that keeps the order."""


def draw_chunk(draw: Draw, config: DataConfig, chunk: tuple[int, int]) -> TensorDict:
    """The trajectories of a chunk (number, count); seed and number alone decide them."""
    number, trajectories = chunk
    return draw(trajectories, config.steps, fold_in(config.seed, number))


def generate(
    scene: Scene,
    config: DataConfig,
    folder: Path,
    quiet: bool = False,
    strategy: tuple[str, Draw] | None = None,
    mapper: Mapper = map,
) -> Path:
    """Write a data set, or finish one that was interrupted.

    A finished one of the same card is left as it is. ``strategy``: name and function of
    another way to draw trajectories than `simulate`. ``mapper`` draws the chunks: here, or
    on other machines as `ray_map`.

    Raises:
        ValueError: the folder cannot be written or holds data of another card.
    """
    name, draw = strategy or (None, partial(simulate, scene))
    card = open_card(scene, config, folder, name)
    if not (writable_folder(folder) / CARD).exists():
        write_json(folder / CARD, card)  # before any chunk, which needs a card
    sizes = [CHUNK] * (config.trajectories // CHUNK)
    sizes += [config.trajectories % CHUNK] * (config.trajectories % CHUNK > 0)
    chunks = list(enumerate(sizes))[card["chunks_done"] :]
    done = sum(sizes[: card["chunks_done"]])
    how = {"desc": f"data {scene.name}", "unit": " transitions", "unit_scale": True}
    how |= {"total": config.trajectories * config.steps, "initial": done * config.steps}
    with tqdm(**how, disable=quiet) as bar:
        drawn = mapper(partial(draw_chunk, draw, config), chunks)
        for (number, count), data in zip(chunks, drawn, strict=True):
            sound = is_sound(data)
            kept = cast(TensorDict, data[sound])
            write_chunk(kept, chunk_path(folder, number))
            card["trajectories"] += len(kept)
            card["dropped"] += count - len(kept)
            beyond = first_beyond(scene, cast(TensorDict, data[~sound]))
            card["beyond"] = Counter(card.get("beyond")) + Counter(beyond)
            card["chunks_done"] = number + 1
            write_json(folder / CARD, card)
            bar.update(count * config.steps)
    return folder


def expect_few_dropped(card: dict[str, Any]) -> None:
    """Refuse a data set of which more than `MOST_DROPPED` had to be dropped.

    Raises:
        ValueError: how many, and what left the bounds first.
    """
    dropped, count = card["dropped"], card["dropped"] + card["trajectories"]
    beyond = Counter(card.get("beyond")).most_common(3)
    first = ", ".join(f"{name} in {count}" for name, count in beyond)
    if dropped > MOST_DROPPED * count:
        raise ValueError(
            f"expected nearly all trajectories to stay within {LARGEST:g}, {dropped} of "
            f"{count} did not; first beyond it: {first}. Give the robot narrower ranges, "
            "weaker actuators or more damping, or a shorter timestep"
        )


def load_data(scene: Scene, *folders: Path) -> TensorDict:
    """Finished data sets of one scene, one after the other, ``[trajectories, steps]``.

    Trajectories are as long as those of the first set; longer ones are cut to pieces.
    A single chunk stays memory-mapped; several are copied to memory.

    Raises:
        ValueError: a data set is missing, unfinished, corrupted, recorded, of another
            scene, or has trajectories that cannot be cut to pieces of that length.
    """
    chunks: list[TensorDict] = []
    for folder in folders:
        found = _load_chunks(scene, folder)
        steps, wanted = found[0].batch_size[1], (chunks or found)[0].batch_size[1]
        if steps % wanted:
            raise ValueError(
                f"expected trajectories of {wanted} steps, as in {folders[0]}, or of a "
                f"multiple in {folder}, got {steps}"
            )
        if steps > wanted:  # [n, k * steps] -> [n * k, steps]
            found = [cast(TensorDict, chunk.reshape(-1, wanted)) for chunk in found]
        chunks += found
    return chunks[0] if len(chunks) == 1 else cast(TensorDict, TensorDict.cat(chunks))


def read_card(scene: Scene, folder: Path) -> tuple[dict[str, Any], DataConfig]:
    """The card of a finished data set of a scene, and its configuration.

    Raises:
        ValueError: it is missing, unfinished, recorded, of another scene or ranges, or too
            many of its trajectories were dropped.
    """
    if not (folder / CARD).is_file():
        raise ValueError(f"expected a data set in {folder}, found no {CARD}")
    card = read_json(folder / CARD)
    if "source" in card:
        raise ValueError(
            f"expected simulated trajectories in {folder}, got recorded ones, which "
            f"`nerd finetune --from {card['source']}` learns from"
        )
    if card.get("scene_hash") != scene.hash:
        raise ValueError(
            f"the data in {folder} are of scene '{card.get('scene')}' "
            f"({card.get('scene_hash')}), expected '{scene.name}' ({scene.hash})"
        )
    ranges = ranges_of(scene.variation)
    if str(card.get("variation")) != str(ranges):  # their order counts
        raise ValueError(
            f"expected data that vary {ranges or 'nothing'}, got {folder}, which vary "
            f"{card.get('variation') or 'nothing'}: give --vary as the data were drawn"
        )
    config = counted(card, folder)
    if card["trajectories"] + card["dropped"] < config.trajectories:
        raise ValueError(
            f"the data in {folder} are not finished: run the command again"
        )
    expect_few_dropped(card)
    return card, config


def _load_chunks(scene: Scene, folder: Path) -> list[TensorDict]:
    card, config = read_card(scene, folder)
    chunks = []
    for number in range(card["chunks_done"]):
        path = chunk_path(folder, number)
        chunks.append(read_chunk(path, 2))
        expect_layout(chunks[-1], scene, config.steps, path)
        expect_finite(chunks[-1], path)
    if (found := sum(map(len, chunks))) != card["trajectories"]:
        raise ValueError(
            f"expected {card['trajectories']} trajectories in {folder}, found {found}"
        )
    return chunks


def open_card(
    scene: Scene, config: DataConfig, folder: Path, strategy: str | None
) -> dict[str, Any]:
    """The card of the data in a folder, or that of data which are yet to be drawn.

    Raises:
        ValueError: the folder holds data of another card.
    """
    fresh = {
        "scene": scene.name,
        "scene_hash": scene.hash,
        "config": asdict(config),
        "strategy": strategy,
        "ranges": scene.sampling.ranges(),
        "variation": ranges_of(scene.variation),
        "mujoco": mujoco.__version__,
        "torchrl_nerd": __version__,
        **dict.fromkeys(("trajectories", "dropped", "chunks_done"), 0),
    }
    fresh = json.loads(json.dumps(fresh))  # as it will be read: tuples become lists
    path = folder / CARD
    if not path.exists():
        return fresh
    card = read_json(path)
    identity = ("scene_hash", "config", "strategy", "ranges", "variation")
    kept, asked = ({key: x.get(key) for key in identity} for x in (card, fresh))
    for about in (kept, asked):
        about["variation"] = str(about["variation"])  # their order counts
    expect_same(f"{folder} already holds data", kept, asked)
    counted(card, folder)
    drawn = min(card["chunks_done"] * CHUNK, config.trajectories)
    if card["trajectories"] + card["dropped"] != drawn:
        raise ValueError(f"expected {path} to count the trajectories of whole chunks")
    return card


def counted(card: dict[str, Any], folder: Path) -> DataConfig:
    """The configuration of a card; counts that cannot be raise ValueError."""
    try:
        config = DataConfig(**card["config"])
        counts = [card[key] for key in ("trajectories", "dropped", "chunks_done")]
        is_whole = all(type(n) is int for n in (*asdict(config).values(), *counts))
        if is_whole and min(counts) >= 0 and sum(counts[:2]) <= config.trajectories:
            return config
    except (KeyError, TypeError, ValueError):
        pass
    raise ValueError(
        f"expected {folder / CARD} to count trajectories, got something else"
    )
