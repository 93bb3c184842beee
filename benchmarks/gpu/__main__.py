"""All that needs a GPU, in order of worth: ``python -m gpu`` in ``benchmarks/``.

    make gpu                       every stage, to results/gpu/
    make gpu ARGS="--only b"       one of them
    make gpu ARGS="--dry-run"      what would run, and what is missing
    make gpu-wheels DIR=wheels     the wheels that a machine with torch and JAX lacks

Each stage writes one JSON file, after each item. A second run measures what is missing.
"""

import argparse
import importlib
import shlex
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

from gpu import wheels

ROOT = Path(__file__).parents[2]


class Stage(NamedTuple):
    """One file of results."""

    module: str
    seconds: float
    about: str


STAGES = {
    "a": Stage(
        "correctness", 60, "every shipped model: device against CPU, bf16, resets"
    ),
    "b": Stage(
        "rates", 140, "control steps/s: presets, sizes, eager, compiled, graphs"
    ),
    "c": Stage(
        "mjx_rates", 80, "the same robots in MJX, and its error at fewer substeps"
    ),
    "d": Stage(
        "learning", 65, "training: updates/s, share of bf16, resume, error by time"
    ),
    "e": Stage("policy", 65, "PPO end to end: frames/s, reward by time"),
    "f": Stage("profiles", 25, "kernels of a step, share of the roofline"),
}
"""In order of worth; with their starts eight minutes together."""

GRACE = 20.0  # s after its time in which a stage must have ended


def parse(words: list[str]) -> argparse.Namespace:
    """Options of the command line."""
    parser = argparse.ArgumentParser(
        "gpu", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", choices=STAGES, nargs="+", help="these stages alone")
    parser.add_argument("--out", type=Path, default=ROOT / "results" / "gpu")
    parser.add_argument("--device", default="cuda", help="cuda, cuda:1, or cpu")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--scale", type=float, default=1.0, help="of the stages' times")
    parser.add_argument("--dry-run", action="store_true", help="list, and do nothing")
    parser.add_argument("--tiny", action="store_true", help="sizes of a test")
    parser.add_argument("--wheels", type=Path, help="download wheels to this folder")
    return parser.parse_args(words)


def plan(device: str) -> list[str]:
    """Stages, wheels with sizes, and what this machine lacks."""
    total = sum(stage.seconds for stage in STAGES.values())
    lines = [f"stages, {total / 60:.0f} minutes at most:"]
    lines += [f"  {k}  {x.seconds:>4.0f} s  {x.about}" for k, x in STAGES.items()]
    size = sum(wheels.WHEELS.values())
    lines.append(f"wheels of `make gpu-wheels`, {size:.0f} MB:")
    lines += [f"  {name:<20} {mb:>5.1f} MB" for name, mb in wheels.WHEELS.items()]
    lines.append("missing here:")
    lacks = [f"  {', '.join(x)} ({what})" for what, x in wheels.missing().items()]
    if not _has_device(device):
        lacks.append(f"  device '{device}' (all stages)")
    return [*lines, *(lacks or ["  nothing"])]


def _has_device(device: str) -> bool:
    try:
        import torch
    except ImportError:
        return False
    return device == "cpu" or torch.cuda.is_available()


def main(words: list[str]) -> int:
    """Run the stages; 2 where something is missing."""
    options = parse(words)
    if options.wheels is not None:
        size = wheels.download(options.wheels, ROOT / "constraints.txt")
        print(f"{size:.1f} MB in {options.wheels}")
        return 0
    if options.dry_run:
        print("\n".join(plan(options.device)))
        return 0
    lacks = wheels.missing()
    if "all stages" in lacks or not _has_device(options.device):
        print("\n".join(plan(options.device)), file=sys.stderr)
        return 2
    for letter in options.only or STAGES:
        if names := lacks.get(f"stage {letter}"):
            print(f"{letter}: not measured, missing {', '.join(names)}", flush=True)
        elif options.only:
            run_stage(letter, options)
        else:
            run_apart(letter, words, options.scale * STAGES[letter].seconds)
    return 0


def run_apart(letter: str, words: list[str], seconds: float) -> None:
    """One stage in a process of its own: a fault of the GPU ends no other stage."""
    command = [sys.executable, "-m", "gpu", *words, "--only", letter]
    try:
        code = subprocess.run(command, timeout=seconds + GRACE).returncode
        how = f"ended with code {code}"
    except subprocess.TimeoutExpired:
        code, how = 1, "was ended after its time"
    if code:
        print(f"{letter}: {how}; what it wrote stays", flush=True)


def run_stage(letter: str, options: argparse.Namespace) -> None:
    """One stage here."""
    import torch

    from gpu.stages import Setup, run_items

    stage, seconds = STAGES[letter], options.scale * STAGES[letter].seconds
    device = torch.device(options.device)
    setup = Setup(device, options.tiny, options.seed, options.out / "runs")
    print(f"{letter}: {stage.about}, {seconds:.0f} s at most", flush=True)
    items = importlib.import_module(f"gpu.{stage.module}").items(setup)
    words = ["--only", letter, "--seed", str(options.seed)]
    words += ["--device", options.device, *(["--tiny"] if options.tiny else [])]
    command = shlex.join(["make", "gpu", f"ARGS={shlex.join(words)}"])
    path = options.out / f"{letter}_{stage.module}.json"
    results = run_items(items, path, setup, seconds, command)
    if results["not_measured"]:
        print(f"  not measured: {', '.join(results['not_measured'])}", flush=True)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
