"""Work that is killed at random times: what is on disk then, and what resuming makes of it.

    python tests/tools/kill_trials.py --kills 100 --seed 0

A child process generates data, trains or saves checkpoints, and tells by a byte after every
interval that is done. It is killed (SIGKILL) at a random time; then what it told of must be
there, everything must load, and a run that goes on must end in the bits of one that nobody
killed, with no temporary file left.
"""

import os
import shutil
import signal
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Protocol, cast

import numpy as np
import torch
import tyro
from torch import Generator
from tqdm import tqdm

from torchrl_nerd.checkpoint import load_checkpoint, make_card, save_checkpoint
from torchrl_nerd.configs import NO_PREDICTIONS, DataConfig, TrainConfig
from torchrl_nerd.data import generate as generation
from torchrl_nerd.data.generate import generate, load_data, simulate
from torchrl_nerd.files import read_json, write_json
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.modules.networks import NETWORKS
from torchrl_nerd.robots import load_scene
from torchrl_nerd.tensor_files import read_tensors
from torchrl_nerd.training.trainer import Trainer

SCENE = "cartpole"
CHUNK = 4  # trajectories, in place of the package's own chunk
DATA = DataConfig(trajectories=40 * CHUNK - 1, steps=4)
TRAIN = TrainConfig(
    network="mlp-4x64",
    steps=20,
    rollout_steps=4,
    batch_size=4,
    sequence_length=2,
    rollout_batch_size=4,
    rollout_length=2,
    save_every=2,
    validate_every=4,
)
SAVES = 40
COLUMNS = ("kills", "losses", "corrupt", "equal", "left over")
Tell = Callable[[], object]


@dataclass
class Options:
    """How often to kill."""

    kills: int = 100
    """In all, in turns among the kinds of work."""
    seed: int = 0
    json: Path | None = None
    """Write the results to this file."""


class Work(Protocol):
    """One kind of work in a folder; `run` goes on with what it finds there."""

    def run(self, folder: Path, tell: Tell) -> None:
        """Work to the end; ``tell`` after each interval that is safe."""
        ...

    def done(self, folder: Path) -> int:
        """Intervals that are on disk; raises ValueError for what cannot be read."""
        ...

    def same(self, folder: Path, whole: Path) -> bool:
        """Whether a finished folder holds the bits of another."""
        ...


class Generating:
    """A data set in chunks."""

    def run(self, folder: Path, tell: Tell) -> None:
        """See `Work`."""
        generation.CHUNK = CHUNK

        def told(draw: Callable, chunks: Iterable) -> Iterator:
            for data in map(draw, chunks):
                yield data
                tell()  # whoever asks for the next one has stored this one

        generate(load_scene(SCENE), DATA, folder, quiet=True, mapper=told)

    def done(self, folder: Path) -> int:
        """See `Work`."""
        path = folder / generation.CARD
        return read_json(path)["chunks_done"] if path.exists() else 0

    def same(self, folder: Path, whole: Path) -> bool:
        """See `Work`."""
        generation.CHUNK = CHUNK
        a, b = (load_data(load_scene(SCENE), path) for path in (folder, whole))
        return bool((a == b).all())


class Training:
    """A training run that saves often."""

    def _trainer(self, folder: Path) -> Trainer:
        scene = load_scene(SCENE)
        data = simulate(scene, 16, 4, Generator().manual_seed(0))
        return Trainer(scene, data, scene, TRAIN, folder, horizons=(2,), quiet=True)

    def run(self, folder: Path, tell: Tell) -> None:
        """See `Work`."""
        trainer = self._trainer(folder)
        while trainer.step < TRAIN.total_steps:
            trainer.run(until=trainer.step + TRAIN.save_every)
            tell()

    def done(self, folder: Path) -> int:
        """See `Work`."""
        step = self._trainer(folder).step
        for name in ("last", "best"):
            if (folder / name / "card.json").exists():
                load_checkpoint(folder / name)
        return step // TRAIN.save_every

    def same(self, folder: Path, whole: Path) -> bool:
        """See `Work`."""
        texts = [(path / "log.csv").read_text() for path in (folder, whole)]
        return texts[0] == texts[1] and all(
            _same_tensors(folder / name, whole / name)
            for name in (
                *("state.safetensors", "last/model.safetensors"),
                "best/model.safetensors",
            )
        )


class Saving:
    """Checkpoints, one over the other: all weights of number n are n."""

    def run(self, folder: Path, tell: Tell) -> None:
        """See `Work`."""
        model = NeRD(load_scene(SCENE), NO_PREDICTIONS, NETWORKS["transformer-2x64"])
        # the last one again: its card may have been left behind by its weights
        for number in range(max(1, self.done(folder)), SAVES + 1):
            for weight in model.network.parameters():
                weight.data.fill_(number)
            save_checkpoint(model, folder, make_card(model, {"number": number}))
            tell()

    def done(self, folder: Path) -> int:
        """See `Work`."""
        if not (folder / "card.json").exists():
            return 0
        weights = list(cast(NeRD, load_checkpoint(folder)).network.parameters())
        numbers = {float(n) for weight in weights for n in weight.detach().unique()}
        if len(numbers) > 1:
            raise ValueError(f"expected weights of one checkpoint, got {numbers}")
        return int(numbers.pop())

    def same(self, folder: Path, whole: Path) -> bool:
        """See `Work`."""
        cards = [read_json(path / "card.json") for path in (folder, whole)]
        tensors = (path / "model.safetensors" for path in (folder, whole))
        return cards[0] == cards[1] and _same_tensors(*tensors)


KINDS: dict[str, Work] = {
    "data": Generating(),
    "training": Training(),
    "checkpoints": Saving(),
}


def _same_tensors(path: Path, other: Path) -> bool:
    a, b = read_tensors(path), read_tensors(other)
    same = (torch.equal(a[key].nan_to_num(), b[key].nan_to_num()) for key in a)
    return a.keys() == b.keys() and all(same)  # a wild step may be no number in both


def in_child(work: Callable[[Tell], object], seconds: float | None = None) -> bytes:
    """What a child process told, a byte each; it is killed after ``seconds``.

    What ``work`` returns is told last, where it lives to return it.
    """
    reader, writer = os.pipe()
    if not (child := os.fork()):
        try:
            torch.set_num_threads(1)
            result = work(lambda: os.write(writer, b"."))
            os.write(writer, str(result).encode())
        finally:
            os._exit(0)
    os.close(writer)
    if seconds is not None:
        time.sleep(seconds)
        os.kill(child, signal.SIGKILL)
    with os.fdopen(reader, "rb") as pipe:
        told = pipe.read()
    os.waitpid(child, 0)
    return told


def trial(work: Work, folder: Path, whole: Path, seconds: float) -> Counter[str] | None:
    """Kill a run after that time and look; None if it was done before."""
    told = in_child(partial(work.run, folder), seconds)
    if told.endswith(b"None"):
        return None
    found = in_child(lambda _: work.done(folder)) if folder.exists() else b"0"
    in_child(partial(work.run, folder))
    same = in_child(lambda _: work.same(folder, whole))
    count = Counter(kills=1, corrupt=not found, equal=same == b"True")
    count["losses"] = bool(found) and int(found) < len(told)
    count["left over"] = len(list(folder.rglob(".*")))
    return count


def main(options: Options) -> dict[str, dict[str, int]]:
    """Print a row for each kind of work."""
    rng, rows = np.random.default_rng(options.seed), {}
    bar = tqdm(total=options.kills)
    with tempfile.TemporaryDirectory() as temporary:
        for index, (name, work) in enumerate(KINDS.items()):
            share = (options.kills + len(KINDS) - 1 - index) // len(KINDS)
            if not share:
                continue
            whole, count = Path(temporary) / f"{name}-whole", Counter[str]()
            began = time.monotonic()
            in_child(partial(work.run, whole))
            longest = time.monotonic() - began
            while count["kills"] < share:
                folder = Path(temporary) / name
                found = trial(work, folder, whole, longest * rng.random())
                shutil.rmtree(folder, ignore_errors=True)
                count += found or Counter()
                bar.update(found is not None)
            rows[name] = {column: count[column] for column in COLUMNS}
    bar.close()
    print(f"{'kind':<14}" + "".join(f"{column:>10}" for column in COLUMNS))
    for name, row in rows.items():
        print(f"{name:<14}" + "".join(f"{row[column]:>10}" for column in COLUMNS))
    if options.json is not None:
        write_json(options.json, {"seed": options.seed, "kinds": rows})
    return rows


if __name__ == "__main__":
    main(tyro.cli(Options))
