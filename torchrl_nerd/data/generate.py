"""Training data: random trajectories of the true dynamics, over all cores, on disk.

NeRD appendix A.2: random initial states and torques, no task. Stored as a memory-mapped
TensorDict ``[trajectories, steps]`` in TorchRL's layout (``qpos``, ``qvel`` and, where the
ground varies, ``terrain``; under ``next`` the same state keys and ``joint_torque``), with a
JSON card beside it.
"""

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import cast

import mujoco
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Generator, Tensor
from tqdm import tqdm

from torchrl_nerd import __version__
from torchrl_nerd.configs import DataConfig
from torchrl_nerd.data.ahead import ahead
from torchrl_nerd.data.store import (
    create_store,
    expect_finite,
    expect_layout,
    read_store,
)
from torchrl_nerd.dynamics.mujoco import MujocoDynamics
from torchrl_nerd.files import read_json, writable_folder, write_json
from torchrl_nerd.keys import QPOS, QVEL, TERRAIN
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.sampling import sample_torques
from torchrl_nerd.seeds import fold_in

CHUNK = 2048  # trajectories stepped together; also what a kill can lose
SEGMENT = 16  # control steps per call of MuJoCo, which keeps every substep of them
LARGEST = 1e5  # reference code: a trajectory beyond this is broken
CARD = "data.json"

Draw = Callable[[int, int, Generator], TensorDict]
"""``(rows, steps, generator) -> trajectories [rows, steps]``, broken ones included."""

Chunk = tuple[int, int]
"""Number of a chunk, and how many trajectories it draws."""

Mapper = Callable[
    [Callable[[Chunk], TensorDict], Iterable[Chunk]], Iterable[TensorDict]
]
"""Python's ``map``, or what does the same elsewhere: results come in order."""


def simulate(scene: Scene, rows: int, steps: int, generator: Generator) -> TensorDict:
    """Trajectories ``[rows, steps]`` from the scene's ranges, broken ones included."""
    dynamics = MujocoDynamics(scene)
    start, scale = scene.sample_initial(rows, generator)
    terrain = start.pop(TERRAIN, None)
    state = TensorDict(start, batch_size=[rows])
    dynamics.reset(state)
    states, torques = [state[:, None]], []
    if scene.sampling.drive is None:
        drawn = sample_torques(
            scene.sampling, scale, steps, scene.control_step, generator
        )
        for held in drawn.split(SEGMENT, 1):
            last = cast(TensorDict, states[-1][:, -1])
            torques.append(held)
            states.append(dynamics.rollout(last, held, terrain))
    else:
        for _ in range(steps):
            last = cast(TensorDict, states[-1][:, -1])
            torque = scene.sampling.drive(last[QPOS], last[QVEL], scale, generator)
            torques.append(torque[:, None])
            states.append(dynamics.rollout(last, torques[-1], terrain))
    return as_transitions(states, torques, terrain)


def as_transitions(
    states: list[TensorDictBase], torques: list[Tensor], terrain: Tensor | None
) -> TensorDict:
    """A data set ``[rows, steps]`` in TorchRL's layout.

    Args:
        states: parts of trajectories, ``[rows, *]``, in order: steps + 1 states in all.
        torques: of the steps between them, parts of ``(rows, *, num_actuated)``.
        terrain: ``(rows, terrain.size)`` where the ground varies.
    """
    path = cast(TensorDict, TensorDict.cat(states, 1))
    data, after = (cast(TensorDict, path[:, a:b]) for a, b in ((0, -1), (1, None)))
    data["next"] = after.set("joint_torque", torch.cat(torques, 1))
    if terrain is not None:
        steps = data.batch_size[1]
        data[TERRAIN] = terrain[:, None].expand(-1, steps, -1).contiguous()
    return data


def is_sound(data: TensorDictBase) -> torch.Tensor:
    """Which trajectories ``[rows, steps]`` stay finite and within bounds, ``(rows,)``."""
    state = torch.cat((data["next", QPOS], data["next", QVEL]), -1)
    return (state.abs() < LARGEST).all(-1).all(-1)


def plain_strategy(scene: Scene) -> tuple[None, Draw]:
    """Trajectories from the scene's own ranges, which cards have no name for."""
    return None, partial(simulate, scene)


def draw_chunk(draw: Draw, config: DataConfig, chunk: Chunk) -> TensorDict:
    """One chunk's trajectories; seed and number decide them, not who draws them."""
    number, rows = chunk
    generator = fold_in(config.seed, number)
    return draw(rows, config.steps, generator)


def generate(
    scene: Scene,
    config: DataConfig,
    folder: Path,
    quiet: bool = False,
    strategy: tuple[str, Draw] | None = None,
    mapper: Mapper = ahead,
) -> Path:
    """Write a data set, or go on with one that was cut short.

    Args:
        scene: the robot.
        config: what to draw.
        folder: where; a finished data set of the same card is left as it is.
        quiet: no progress bar.
        strategy: another way to draw trajectories than `simulate`, and its name, by
            which the card knows it.
        mapper: where chunks are drawn: here, each while the one before is written, or as
            `ray_map` does.

    Raises:
        ValueError: the folder cannot be written or holds data of another card.
    """
    name, draw = strategy or plain_strategy(scene)
    card = _open_card(scene, config, writable_folder(folder), name)
    store = _open_store(draw, config, folder, card["chunks_done"])
    chunks = [
        (number, min(CHUNK, config.trajectories - number * CHUNK))
        for number in range(card["chunks_done"], -(-config.trajectories // CHUNK))
    ]
    bar = tqdm(
        total=config.trajectories * config.steps,
        initial=min(card["chunks_done"] * CHUNK, config.trajectories) * config.steps,
        unit=" transitions",
        unit_scale=True,
        desc=f"data {scene.name}",
        disable=quiet,
    )
    drawn = mapper(partial(draw_chunk, draw, config), chunks)
    for (number, rows), data in zip(chunks, drawn, strict=True):
        sound = is_sound(data)
        kept = data if sound.all() else data[sound]
        first = card["trajectories"]
        store[first : first + len(kept)] = kept
        card["trajectories"] += len(kept)
        card["dropped"] += int((~sound).sum())
        card["chunks_done"] = number + 1
        write_json(folder / CARD, card)
        bar.update(rows * config.steps)
    bar.close()
    return folder


def load_data(scene: Scene, folder: Path) -> TensorDict:
    """A finished data set, memory-mapped, ``[trajectories, steps]``.

    Raises:
        ValueError: nothing there, not finished, or of another scene.
    """
    if not (folder / CARD).is_file():
        raise ValueError(f"expected a data set in {folder}, found no {CARD}")
    card = read_json(folder / CARD)
    if card.get("scene_hash") != scene.hash:
        raise ValueError(
            f"the data in {folder} are of scene '{card.get('scene')}' "
            f"({card.get('scene_hash')}), expected '{scene.name}' ({scene.hash})"
        )
    config = _check_counts(card, folder)
    if card["trajectories"] + card["dropped"] < config.trajectories:
        raise ValueError(
            f"the data in {folder} are not finished: run the command again"
        )
    data = read_store(folder)[: card["trajectories"]]
    expect_layout(data, scene, config.steps, folder)
    expect_finite(data, folder)
    return data


def load_data_sets(scene: Scene, folders: Sequence[Path]) -> TensorDict:
    """Finished data sets of one scene, one after the other, ``[trajectories, steps]``.

    A single one stays memory-mapped; several are copied to memory.

    Raises:
        ValueError: as of `load_data`, or trajectories of several lengths.
    """
    sets = [load_data(scene, folder) for folder in folders]
    for folder, data in zip(folders, sets, strict=True):
        steps, expected = data.batch_size[1], sets[0].batch_size[1]
        if steps != expected:
            raise ValueError(
                f"expected trajectories of {expected} steps in {folder}, as in "
                f"{folders[0]}, got {steps}"
            )
    return sets[0] if len(sets) == 1 else cast(TensorDict, TensorDict.cat(sets))


def _open_card(
    scene: Scene, config: DataConfig, folder: Path, strategy: str | None
) -> dict:
    fresh = {
        "scene": scene.name,
        "scene_hash": scene.hash,
        "config": asdict(config),
        "strategy": strategy,
        "ranges": scene.sampling.ranges(),
        "mujoco": mujoco.__version__,
        "torchrl_nerd": __version__,
        "trajectories": 0,
        "dropped": 0,
        "chunks_done": 0,
    }
    fresh = json.loads(json.dumps(fresh))
    path = folder / CARD
    if not path.exists():
        write_json(path, fresh)  # before any data: they never outlive their card
        return fresh
    card = read_json(path)
    ranges = card.get("ranges")
    if isinstance(ranges, dict):  # older cards also list what is not set
        card["ranges"] = {k: v for k, v in ranges.items() if v is not None}
    for key in ("scene_hash", "config", "strategy", "ranges"):
        if card.get(key) != fresh[key]:
            raise ValueError(
                f"{folder} already holds data with {key} {card.get(key)}, asked for "
                f"{fresh[key]}: choose another folder"
            )
    _check_counts(card, folder)
    done = card["chunks_done"]
    if type(done) is not int or card["trajectories"] + card["dropped"] != min(
        done * CHUNK, config.trajectories
    ):
        raise ValueError(f"expected {path} to count whole chunks, got {done!r} of them")
    return card


def _check_counts(card: dict, folder: Path) -> DataConfig:
    """The configuration of a card whose counts are possible."""
    try:
        config = DataConfig(**card["config"])
        counts = card["trajectories"], card["dropped"]
        numbers = *asdict(config).values(), *counts
        if not all(type(n) is int for n in numbers) or min(counts) < 0:
            raise ValueError
        if sum(counts) > config.trajectories:
            raise ValueError
    except (KeyError, TypeError, ValueError):
        raise ValueError(
            f"expected {folder / CARD} to count trajectories, got something else"
        ) from None
    return config


def _open_store(
    draw: Draw, config: DataConfig, folder: Path, done: int
) -> TensorDictBase:
    """The memory-mapped tensordict, created where nothing is in it yet."""
    example = draw(1, 1, Generator().manual_seed(0))
    shape = [config.trajectories, config.steps]
    example = example.expand(*shape)
    if not done:
        return create_store(example, folder)
    store = read_store(folder)
    for key, value in example.items(True, True):
        found = store.get(key, None)
        if found is None or (found.shape, found.dtype) != (value.shape, value.dtype):
            raise ValueError(
                f"expected {key!r} of shape {tuple(value.shape)} in {folder}"
            )
    return store
