"""How fast data are made by workers of Ray on this machine, and without them.

    RAY_worker_niceness=0 python benchmarks/ray_rate.py ant

The same chunks; both in turns, so that a busy machine slows both. Without the variable
Ray's workers give way to everything else that runs.
"""

import logging
import os
import resource
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import ray
import tyro
from tyro.conf import Positional

from torchrl_nerd.configs import DataConfig
from torchrl_nerd.data.cluster import ray_map
from torchrl_nerd.data.generate import CHUNK, Mapper, generate
from torchrl_nerd.evaluation.results import write_results
from torchrl_nerd.robots import load_scene
from torchrl_nerd.scenes import Scene


@dataclass
class Options:
    """What to draw, and how often."""

    scene: Positional[str] = "cartpole"
    chunks: int = 4
    steps: int = 50
    rounds: int = 4
    """The first is not counted: workers start in it."""
    seed: int = 0
    json: Path | None = None
    """Write the results to this file."""


def seconds_of(mapper: Mapper, scene: Scene, options: Options, index: int) -> float:
    """What `nerd data` takes, on disk."""
    seed = options.seed + index
    config = DataConfig(options.chunks * CHUNK, options.steps, seed)
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        generate(scene, config, Path(folder), quiet=True, mapper=mapper)
        return time.perf_counter() - began


def largest_memory(_: int) -> tuple[int, float]:
    """Of the process that is asked, MiB; and which it is."""
    used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return os.getpid(), used / 1024


def main(options: Options) -> None:
    """Print both rates and what a worker takes."""
    scene, count = load_scene(options.scene), os.cpu_count() or 1
    began = time.perf_counter()
    ray.init("local", log_to_driver=False, logging_level=logging.ERROR)
    start = time.perf_counter() - began
    times: dict[str, list[float]] = {"here": [], "ray": []}
    for index in range(options.rounds):
        times["here"].append(seconds_of(map, scene, options, index))
        times["ray"].append(seconds_of(ray_map, scene, options, index))
    memory = dict(ray_map(largest_memory, range(4 * count)))
    ray.shutdown()
    transitions = options.chunks * CHUNK * options.steps
    here, there = (transitions / median(x[1:]) for x in times.values())
    print(
        f"{scene.name}, {count} processors, transitions/s: one process {here:,.0f}, "
        f"{len(memory)} workers {there:,.0f}, {there / here:.0%}; "
        f"{max(memory.values()):.0f} MiB a worker at most; Ray started in {start:.1f} s, "
        f"the first round took {times['ray'][0]:.1f} s"
    )
    if options.json is not None:
        results = {"one_process_per_s": here, "ray_per_s": there, "start_s": start}
        results |= {"first_s": times["ray"][0], "worker_mib": max(memory.values())}
        results |= {"scene": scene.name, "workers": count}
        write_results(options.json, results, options.seed)


if __name__ == "__main__":
    main(tyro.cli(Options))
