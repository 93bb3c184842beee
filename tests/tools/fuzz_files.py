"""Corrupted files through every public loader: refused in one sentence, or sound.

    python tests/tools/fuzz_files.py --files 10000 --seed 0 --json fuzz.json

Files are loaded in child processes with limits on time and memory. A loss is anything but
a sound object or one sentence as a ValueError: another exception, a crash, a hang, a
pickle that was run, a file made outside the sample's own folder. ``--first N --files 1``
repeats file N of a seed.
"""

import json
import os
import resource
import shutil
import signal
import tempfile
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from corruptions import bomb, corrupt
from file_kinds import KINDS, Found, Kind
from tqdm import tqdm

from torchrl_nerd.files import write_json

SECONDS = 10
MEMORY = 2**30  # bytes beyond what the process has at its start
BATCH = 25  # files to a process
OUTCOMES = ("valid", "refused", "loss")
INSIDE = Path("a/b/sample")  # "../../x" from there is still in the work folder
Shapes = dict[str, torch.Size]


@dataclass
class Options:
    """What to spoil, and how often."""

    files: int = 10_000
    seed: int = 0
    first: int = 0
    """Number of the first file: to repeat one, or to go on."""
    json: Path | None = None
    """Write the results to this file."""


def in_child(work: Callable[[], Iterable[str]]) -> list[str]:
    """What ``work`` yields in a process of its own, and how that died, if it did."""
    reader, writer = os.pipe()
    if not (child := os.fork()):
        try:
            for line in work():
                os.write(writer, json.dumps(line).encode() + b"\n")
        except Exception:  # of this tool itself
            traceback.print_exc()
        finally:
            os._exit(0)
    os.close(writer)
    with os.fdopen(reader, "rb") as pipe:
        said = [json.loads(line) for line in pipe.read().splitlines()]
    status = os.waitpid(child, 0)[1]
    if os.WIFSIGNALED(status):
        name = signal.Signals(os.WTERMSIG(status)).name
        said.append("hang" if name == "SIGALRM" else f"crash by {name}")
    return said


def outcome(kind: Kind, folder: Path, shapes: Shapes) -> str:
    """``valid``, ``refused``, or what is wrong with how the folder was loaded."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = kind.load(folder)
    except ValueError as error:
        lines = str(error).splitlines()
        return "refused" if len(lines) == 1 else f"{len(lines)} lines: {lines[:2]}"
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)
        own = [frame for frame in place if "torchrl_nerd" in frame.filename] or place
        where = f"{Path(own[-1].filename).name}:{own[-1].lineno}"
        return f"{type(error).__name__} at {where}: {str(error)[:200]}"
    if kind.same_shapes and shapes_of(found) != shapes:
        return "other names or shapes than those of the sample"
    odd = [name for name, value in found.items() if not value.isfinite().all()]
    return f"not finite: {odd[:3]}" if odd else "valid"


def shapes_of(found: Found) -> Shapes:
    """Shapes by name."""
    return {name: value.shape for name, value in found.items()}


class Samples:
    """A sound sample of every kind, made once, each in a process of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.shapes: dict[str, Shapes] = {}
        for name in KINDS:
            (said,) = in_child(lambda name=name: self._make(name))
            shapes = json.loads(said)
            self.shapes[name] = {key: torch.Size(v) for key, v in shapes.items()}

    def _make(self, name: str) -> Iterator[str]:
        place, copy = self.folder / name, self.folder / f"{name} again"
        place.mkdir(parents=True)
        torch.manual_seed(0)
        KINDS[name].make(place)
        shutil.copytree(place, copy)
        yield json.dumps(shapes_of(KINDS[name].load(copy)))


def spoil(samples: Samples, root: Path, seed: int, index: int) -> tuple[str, str]:
    """Put file ``index`` of a seed under ``root``; returns its kind and what was done."""
    rng = np.random.default_rng((seed, index))
    name = str(rng.choice(sorted(KINDS)))
    shutil.rmtree(root, ignore_errors=True)
    shutil.copytree(samples.folder / name, root / INSIDE)
    return name, corrupt(root / INSIDE, rng, root.parent / "marker")


def try_file(samples: Samples, root: Path, name: str) -> str:
    """The outcome of what `spoil` put there."""
    marker, place = root.parent / "marker", root / INSIDE
    said = outcome(KINDS[name], place, samples.shapes[name])
    if marker.exists():
        marker.unlink()
        said = f"a pickle was run; {said}"
    if len([*root.iterdir(), *place.parent.parent.iterdir()]) != 2:
        said = f"files outside the folder; {said}"
    return said


def try_files(
    samples: Samples, root: Path, seed: int, numbers: list[int]
) -> Iterator[tuple[int, str, str, str]]:
    """Number, kind, what was done and outcome of each file."""

    def work() -> Iterator[str]:
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        most = pages * resource.getpagesize() + MEMORY
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
        for number in numbers:
            name, done = spoil(samples, root, seed, number)
            yield name
            yield done
            signal.alarm(SECONDS)
            said = try_file(samples, root, name)
            signal.alarm(0)
            yield said

    while numbers:
        said = in_child(work)
        found = list(zip(said[::3], said[1::3], said[2::3], strict=False))
        if not found:
            raise RuntimeError(f"file {numbers[0]} could not be corrupted")
        for number, each in zip(numbers, found, strict=False):
            yield number, *each
        numbers = numbers[len(found) :]


def main(options: Options) -> dict[str, dict[str, int]]:
    """Print every loss and a table of outcomes."""
    torch.set_num_threads(1)
    bomb()  # made once, for all processes
    counts: dict[str, Counter[str]] = {name: Counter() for name in KINDS}
    losses, last = [], options.first + options.files
    with tempfile.TemporaryDirectory() as temporary, tqdm(total=options.files) as bar:
        samples, root = Samples(Path(temporary) / "samples"), Path(temporary) / "work"
        for first in range(options.first, last, BATCH):
            batch = list(range(first, min(first + BATCH, last)))
            for number, name, done, said in try_files(
                samples, root, options.seed, batch
            ):
                is_loss = said not in OUTCOMES
                counts[name]["loss" if is_loss else said] += 1
                bar.update()
                if is_loss:
                    about = f"--seed {options.seed} --first {number}"
                    losses.append(ascii(f"{about}: {name}: {done}: {said}")[1:-1])
                    bar.write(losses[-1])
    table = {name: {o: count[o] for o in OUTCOMES} for name, count in counts.items()}
    print(f"{'kind':<20}" + "".join(f"{o:>10}" for o in OUTCOMES))
    for name, row in table.items():
        print(f"{name:<20}" + "".join(f"{row[o]:>10}" for o in OUTCOMES))
    if options.json is not None:
        about = {"seed": options.seed, "first": options.first, "files": options.files}
        write_json(options.json, {**about, "outcomes": table, "losses": losses})
    return table


if __name__ == "__main__":
    main(tyro.cli(Options))
