"""Whether anything got slower: ratios of speeds against a baseline that is committed.

    python benchmarks/bench_check.py            # what `make bench-check` does
    python benchmarks/bench_check.py --write    # on an idle machine, after a wanted change

Ratios say the same on a fast machine and on a slow one: learned against MuJoCo, streaming
against the window, compiled against eager, the whole env against its dynamics. All take
turns in one process; a ratio is the median over rounds, of which there are more until its
spread is small. Exits with 1 and a sentence for each ratio that got worse.
"""

import copy
import sys
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import quantiles
from typing import Any, cast

import mujoco
import torch
import tyro
from tensordict import TensorDictBase
from torchrl.collectors import Collector
from tqdm import tqdm

from torchrl_nerd.dynamics import MujocoDynamics, NeRDDynamics
from torchrl_nerd.envs.base import SceneEnv
from torchrl_nerd.evaluation.bench.candidates import Candidate, models
from torchrl_nerd.evaluation.bench.rates import Runner, mid_states, stepper
from torchrl_nerd.files import read_json, write_json
from torchrl_nerd.keys import ACTION
from torchrl_nerd.robots import make_task
from torchrl_nerd.scenes import Scene
from torchrl_nerd.settings import expect_at_least
from torchrl_nerd.tasks import Task

BASELINE = Path(__file__).with_name("bench_baseline.json")
TOLERANCE = 0.2
"""Share by which a ratio may fall: on a busy machine the same code's fell by up to 17%
between two runs, by 12% beyond its spread; most stayed within 8%."""
LEAST_ROUNDS = 5
MUJOCO = "MuJoCo"


@dataclass
class Options:
    """What to measure, for how long, and against what."""

    tasks: tuple[str, ...] = ("cartpole/swingup", "double_pendulum/passive", "ant/run")
    num_envs: int = 512
    spread: float = 0.05
    """Rounds go on until every ratio's median is known to this share..."""
    rounds: int = 60
    """...or so many are done."""
    seed: int = 0
    threads: int = 1
    """Of torch and of MuJoCo: more would make ratios depend on the machine."""
    write: bool = False
    """Write the baseline instead of comparing with it."""
    baseline: Path = BASELINE


@dataclass(frozen=True)
class Ratio:
    """Of two speeds, more is better; ``spread``: how well the median is known, a share."""

    value: float
    spread: float


@dataclass(frozen=True)
class Sample:
    """Control steps of the whole batch per second: the dynamics alone, and in the env."""

    steps_per_s: float
    env_steps_per_s: float


def summarize(samples: list[float]) -> Ratio:
    """Median over rounds and half the width of its notch, 1.57 IQR / sqrt(n), a share."""
    low, middle, high = quantiles(samples, n=4)
    return Ratio(middle, 1.57 * (high - low) / len(samples) ** 0.5 / middle)


def ratios(samples: Mapping[str, Sample]) -> dict[str, float]:
    """Ratios of one round, by what they compare."""
    mujoco, found = samples[MUJOCO], {}
    for name in samples:
        if "," in name or name == MUJOCO:
            continue
        alone = samples[name].steps_per_s
        found[f"{name} / MuJoCo"] = alone / mujoco.steps_per_s
        found[f"{name}: env / dynamics"] = samples[name].env_steps_per_s / alone
        if f"{name}, window" in samples:
            window = samples[f"{name}, window"].steps_per_s
            found[f"{name}: streaming / window"] = alone / window
        compiled = samples[f"{name}, compiled"].steps_per_s
        found[f"{name}: compiled / eager"] = compiled / alone
    return found


def compare(
    found: Mapping[str, Ratio], baseline: Mapping[str, float], tolerance: float
) -> list[str]:
    """A sentence for each ratio that is worse than its baseline; none where all is well.

    A ratio is worse if even its median and spread together are below the baseline by
    more than ``tolerance`` (a share), or if it is in one of the two only.
    """
    said = []
    for name in sorted(found.keys() | baseline.keys()):
        if name not in found or name not in baseline:
            where = "measured" if name in found else "in the baseline"
            said.append(f"{name} is only {where}: write a new baseline.")
            continue
        now, before = found[name], baseline[name]
        if not now.value * (1.0 + now.spread) >= before * (1.0 - tolerance):  # NaN is
            said.append(
                f"{name} fell from {before:.3g} to {now.value:.3g} "
                f"(+-{now.spread:.0%}), by more than {tolerance:.0%}."
            )
    return said


def candidates(scene: Scene, threads: int) -> list[Candidate]:
    """MuJoCo at the scene's own substeps, and the shipped models."""
    own = Candidate(MUJOCO, "simulator", lambda here: MujocoDynamics(here, threads))
    return [own, *models(scene, variants=("compiled", "window"))]


def runners(task: Task, options: Options) -> dict[str, tuple[Runner, Runner]]:
    """Of every candidate, warm: its dynamics, and its env."""
    state = mid_states(task, options.num_envs, options.seed)
    return {
        c.name: (
            Runner(stepper(c.make(task.scene), state)),
            Runner(_env_stepper(c, task, options)),
        )
        for c in candidates(task.scene, options.threads)
    }


def one_round(
    found: Mapping[str, tuple[Runner, Runner]], num_envs: int
) -> dict[str, Sample]:
    """One sample of each candidate, by its name."""
    return {
        name: Sample(*(num_envs * runner.steps_per_s() for runner in both))
        for name, both in found.items()
    }


def _env_stepper(
    candidate: Candidate, task: Task, options: Options
) -> Callable[[int], None]:
    """Steps of an env with random actions, through TorchRL's collector."""
    dynamics, here = candidate.make(task.scene), copy.copy(task)
    here.scene = dynamics.scene  # of as many substeps
    env = SceneEnv(here, dynamics, options.num_envs, options.seed)
    if getattr(dynamics, "compile", False):
        env.compile()
    collectors: dict[int, Collector] = {}

    def act(tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set(ACTION, env.action_spec.rand())

    def run(steps: int) -> None:
        if steps not in collectors:  # made where it is not timed: see Runner
            collectors.clear()
            collectors[steps] = Collector(
                env,
                act,  # TorchRL's own random policy takes five times as long
                frames_per_batch=options.num_envs * steps,
                total_frames=-1,
                track_traj_ids=False,
                auto_register_policy_transforms=False,
            )
        next(iter(collectors[steps]))

    return run


def measure(options: Options) -> dict[str, Ratio]:
    """Measure every task until the ratios are known, or the rounds are done."""
    found = {}
    for task_id in options.tasks:
        task = make_task(task_id)
        chosen = runners(task, options)
        rounds: list[dict[str, float]] = []
        known: dict[str, Ratio] = {}
        for _ in tqdm(range(options.rounds), task_id, disable=None):
            rounds.append(ratios(one_round(chosen, options.num_envs)))
            if len(rounds) < LEAST_ROUNDS:
                continue
            known = {
                name: summarize([one[name] for one in rounds]) for name in rounds[0]
            }
            if max(ratio.spread for ratio in known.values()) <= options.spread:
                break
        found |= known
    return found


def conditions(options: Options) -> dict[str, Any]:
    """What a baseline holds for: tasks, batch, threads and networks."""
    networks = {}
    for task_id in options.tasks:
        scene = make_task(task_id).scene
        made = {c.name: c.make(scene) for c in models(scene)}
        networks |= {
            name: asdict(cast(Any, dynamics.model.config))
            for name, dynamics in made.items()
            if isinstance(dynamics, NeRDDynamics)
        }
    return {"rows": options.num_envs, "threads": options.threads, "networks": networks}


def read_baseline(path: Path, conditions: Mapping[str, Any]) -> dict[str, float]:
    """Its ratios.

    Raises:
        ValueError: no such file, or one for other conditions (named).
    """
    baseline = read_json(path)
    for name, value in conditions.items():
        if baseline.get(name) != value:
            raise ValueError(f"{path} has other {name}: write a new baseline")
    return {name: row["value"] for name, row in baseline["ratios"].items()}


def main(options: Options) -> list[str]:
    """Print every ratio; return what got worse, nothing where the baseline is written.

    Raises:
        ValueError: a setting out of range, or a baseline that does not fit.
    """
    expect_at_least(LEAST_ROUNDS, rounds=options.rounds)
    expect_at_least(1, num_envs=options.num_envs, threads=options.threads)
    torch.set_num_threads(options.threads)
    about = conditions(options)
    before = {} if options.write else read_baseline(options.baseline, about)
    found = measure(options)
    for name, ratio in found.items():
        was = f", was {before[name]:.3g}" if name in before else ""
        print(f"{name:<55}{ratio.value:>9.3g} +-{ratio.spread:.0%}{was}")
    if options.write:
        versions = {"torch": torch.__version__, "mujoco": mujoco.__version__}
        rows = {name: asdict(ratio) for name, ratio in found.items()}
        write_json(options.baseline, about | versions | {"ratios": rows})
        return []
    return compare(found, before, TOLERANCE)


if __name__ == "__main__":
    try:
        WORSE = main(tyro.cli(Options))
    except ValueError as error:
        sys.exit(str(error))
    sys.exit("\n".join(WORSE) if WORSE else 0)
