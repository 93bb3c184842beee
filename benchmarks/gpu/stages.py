"""A stage is a list of items, each measured alone; what is done is not done again."""

import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import torch

from torchrl_nerd.evaluation.results import read_results, write_results
from torchrl_nerd.keys import QPOS

Item = Callable[[], dict[str, Any]]


@dataclass(frozen=True)
class Setup:
    """Where and how large.

    | field | meaning |
    |---|---|
    | ``device`` | of models and states |
    | ``is_tiny`` | sizes for a test on the CPU, which measure nothing |
    | ``seed`` | of states, weights and actions |
    | ``folder`` | for runs of training |
    """

    device: torch.device
    is_tiny: bool = False
    seed: int = 0
    folder: Path = Path("runs/gpu")

    def described(self) -> dict[str, Any]:
        """What results depend on, as JSON has it."""
        about = {"device": str(self.device), "is_tiny": self.is_tiny}
        return about | {"seed": self.seed}

    @property
    def is_gpu(self) -> bool:
        """Whether times are a GPU's."""
        return self.device.type == "cuda"

    def pick(self, full: Any, tiny: Any) -> Any:
        """The size for a measurement or for a test."""
        return tiny if self.is_tiny else full

    def wait(self) -> None:
        """Until the device has done all its work."""
        if self.is_gpu:
            torch.cuda.synchronize(self.device)


class OutOfTimeError(Exception):
    """The stage's time is over."""


@contextmanager
def limited(seconds: float) -> Iterator[None]:
    """Raise `OutOfTimeError` in this thread after so many seconds."""

    def stop(*_: object) -> None:
        raise OutOfTimeError

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, max(seconds, 1e-3))
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def run_items(
    items: dict[str, Item], path: Path, setup: Setup, seconds: float, command: str
) -> dict[str, Any]:
    """Measure what the file does not have, in order, and write it after each item.

    An item that fails leaves its error in one line, and is tried again by the next run.

    Args:
        items: by name, in order of worth.
        path: JSON file in the schema of ``results/``.
        setup: where and how large.
        seconds: after which the stage ends.
        command: that makes the file again.

    Returns:
        The results: ``items`` by name, and the names under ``not_measured``.
    """
    done: dict[str, Any] = {}
    if path.exists():
        found = cast(dict, read_results(path)["results"])
        if found.get("setup") == setup.described():  # of another one nothing is kept
            done = found["items"]
    done = {name: x for name, x in done.items() if name in items and "error" not in x}
    ends = time.monotonic() + seconds
    for name, item in items.items():
        if name in done:
            continue
        began = time.monotonic()
        if began >= ends:
            break
        try:
            with limited(ends - began):
                found = item()
        except OutOfTimeError:
            found = {"error": f"out of time after {time.monotonic() - began:.0f} s"}
        except Exception as error:  # one item must not take the others with it
            first = (str(error).strip().splitlines() or [""])[0]
            found = {"error": f"{type(error).__name__}: {first}"[:300]}
        done[name] = found | {"seconds": round(time.monotonic() - began, 2)}
        print(f"  {name}: {_brief(found)}", flush=True)
        _write(path, items, done, setup, command)
    return _write(path, items, done, setup, command)


def _write(
    path: Path, items: dict[str, Item], done: dict[str, Any], setup: Setup, command: str
) -> dict[str, Any]:
    missing = [name for name in items if "error" in done.get(name, {"error": ""})]
    results = {"items": done, "not_measured": missing, "setup": setup.described()}
    path.parent.mkdir(parents=True, exist_ok=True)
    how = {"command": command, "device": str(setup.device)}
    write_results(path, results, setup.seed, **how)
    return results


def _brief(found: dict[str, Any]) -> str:
    parts = [
        f"{key} {value:,.4g}" if isinstance(value, float) else f"{key} {value}"
        for key, value in found.items()
        if isinstance(value, int | float | str)
    ]
    return ", ".join(parts) or "done"


def rate(step: Callable[[], object], setup: Setup, warmup: int = 3) -> dict[str, float]:
    """Calls per second: the median of five samples, and their spread.

    Args:
        step: what is timed; the device has done nothing else meanwhile.
        setup: how long a sample lasts: 0.1 s, or two calls.
        warmup: calls before the first sample.
    """
    for _ in range(warmup):
        step()
    setup.wait()
    began = time.perf_counter()
    step()
    setup.wait()
    once = time.perf_counter() - began
    calls = setup.pick(max(2, round(0.1 / max(once, 1e-6))), 2)
    samples = []
    for _ in range(setup.pick(5, 1)):
        setup.wait()
        began = time.perf_counter()
        for _ in range(calls):
            step()
        setup.wait()
        samples.append(calls / (time.perf_counter() - began))
    samples.sort()
    middle = samples[len(samples) // 2]
    return {"per_s": middle, "spread": (samples[-1] - samples[0]) / middle}


def ceilings(setup: Setup) -> dict[str, float]:
    """What the device reaches: bf16 products, and copies (bytes read and written)."""
    size = setup.pick(8192, 64)
    how = {"device": setup.device, "dtype": torch.bfloat16}
    a, b = torch.randn(size, size, **how), torch.randn(size, size, **how)
    product = rate(lambda: a @ b, setup)["per_s"]
    source = torch.empty(
        setup.pick(2**30, 2**16), dtype=torch.uint8, device=setup.device
    )
    target = torch.empty_like(source)
    copy = rate(lambda: target.copy_(source), setup)["per_s"]
    return {
        "bf16_flop_per_s": product * 2.0 * size**3,
        "copy_bytes_per_s": copy * 2.0 * len(source),
    }


def farthest(a: Any, b: Any) -> float:
    """Largest difference of ``qpos`` in two tensordicts, wherever they are."""
    return float((a[QPOS].cpu() - b[QPOS].cpu()).abs().max())
