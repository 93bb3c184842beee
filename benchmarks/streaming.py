"""One token a step against the paper's window of ten, recomputed, by preset.

    python benchmarks/streaming.py
    python benchmarks/streaming.py cartpole --presets paper --num-envs 64 --no-compile

Untrained networks of the scene's sizes, since their speed does not depend on weights; that
both have the same error is seen with trained ones: `nerd bench cartpole --variants window`.
All take turns in one run.
"""

from dataclasses import asdict, dataclass
from pathlib import Path

import torch
import tyro
from scaling import two_in_turn
from tyro.conf import Positional

from torchrl_nerd.configs import NO_PREDICTIONS
from torchrl_nerd.dynamics import NeRDDynamics
from torchrl_nerd.evaluation.bench.rates import Runner, mid_states, stepper
from torchrl_nerd.evaluation.results import write_results
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.modules.networks import network_config
from torchrl_nerd.robots import load_scene
from torchrl_nerd.scenes import Scene


@dataclass
class Options:
    """What to time, and how often."""

    scene: Positional[str] = "ant"
    presets: tuple[str, ...] = ("transformer-2x64", "transformer-4x128", "paper")
    num_envs: int = 512
    rounds: int = 5
    compile: bool = True
    """Time compiled models as well."""
    threads: int = 2
    seed: int = 0
    json: Path | None = None
    """Write the results to this file."""


@dataclass(frozen=True)
class Speed:
    """Control steps per second, medians over turns; and the ratio's in the same turn."""

    preset: str
    is_compiled: bool
    streaming_per_s: float
    window_per_s: float
    ratio: float


def measure(scene: Scene, preset: str, is_compiled: bool, options: Options) -> Speed:
    """Both ways of one network."""
    state = mid_states(scene, options.num_envs, options.seed)
    model = NeRD(scene, NO_PREDICTIONS, network_config(preset))
    streaming, window = (
        Runner(stepper(NeRDDynamics(model, way, compile=is_compiled), state))
        for way in ("streaming", "window")
    )
    fast, slow, ratio = two_in_turn(streaming, window, options.rounds)
    num_envs = options.num_envs
    return Speed(preset, is_compiled, num_envs * fast, num_envs * slow, ratio)


def main(options: Options) -> list[Speed]:
    """Print a row for every preset, eager and compiled."""
    torch.set_num_threads(options.threads)
    scene, found = load_scene(options.scene), []
    print(f"{scene.name}, {options.num_envs} envs, {options.threads} threads, steps/s")
    print(f"{'preset':<22}{'streaming':>11}{'window':>9}{'ratio':>7}")
    for preset in options.presets:
        for is_compiled in (False, True)[: 1 + options.compile]:
            x = measure(scene, preset, is_compiled, options)
            name = f"{preset}, compiled" if is_compiled else preset
            rates = f"{x.streaming_per_s:>11,.0f}{x.window_per_s:>9,.0f}{x.ratio:>7.1f}"
            print(f"{name:<22}{rates}", flush=True)
            found.append(x)
    if options.json is not None:
        about = {
            "scene": scene.name,
            "rows": options.num_envs,
            "threads": options.threads,
        }
        speeds = [asdict(x) for x in found]
        write_results(options.json, {**about, "speeds": speeds}, options.seed)
    return found


if __name__ == "__main__":
    main(tyro.cli(Options))
