"""PPO frames per second, collection and update, in learned dynamics and in MuJoCo.

    PYTHONPATH=examples python benchmarks/ppo_rate.py
    PYTHONPATH=examples python benchmarks/ppo_rate.py --tasks ant/run --no-compile

Every task with a goal and a shipped model, with the policy, the update and the settings of
`examples/ppo.py`. NeRD, eager and compiled, and MuJoCo take turns of one batch and its
update; the first turn of each is not counted. torch has one thread, and it is the time of
the processor that counts, which other work disturbs little. Threads add up in it: those of
MuJoCo's pool count as a cost, and not as speed.
"""

import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import median

import torch
import tyro
from ppo import Run, make_learning, make_policy_and_critic, update
from tensordict import TensorDictBase
from torchrl.collectors import Collector

from torchrl_nerd import make_env
from torchrl_nerd.checkpoint import shipped_card, shipped_models
from torchrl_nerd.envs.frame_stack import stack_frames
from torchrl_nerd.evaluation.policy import make_actor
from torchrl_nerd.evaluation.results import write_results
from torchrl_nerd.robots import PPO_CONFIGS
from torchrl_nerd.settings import expect_at_least

MUJOCO = "MuJoCo"


@dataclass
class Options:
    """What to time, and how often."""

    tasks: tuple[str, ...] = ()
    """Those with a goal and a shipped model by default."""
    rounds: int = 3
    num_envs: int | None = None
    """The task's own by default."""
    compile: bool = True
    """Time the compiled env as well."""
    seed: int = 0
    json: Path | None = None
    """Write the results to this file."""


@dataclass(frozen=True)
class Speed:
    """Of PPO in one dynamics, per second of the processor: medians over turns.

    | field | meaning |
    |---|---|
    | ``frames_per_s`` | collection and update |
    | ``collected_per_s`` | collection alone |
    | ``ratio`` | ``frames_per_s`` to MuJoCo's in the same round |
    """

    frames_per_s: float
    collected_per_s: float
    ratio: float


class Learner:
    """PPO in one dynamics, a batch at a time.

    Args:
        cfg: task, dynamics and settings.
        compile: run learned dynamics through `torch.compile`.
    """

    def __init__(self, cfg: Run, compile: bool = False) -> None:
        torch.manual_seed(cfg.seed)
        self.cfg, self.frames = cfg, cfg.num_envs * cfg.horizon
        env = make_env(cfg.task, cfg.dynamics, cfg.num_envs, cfg.seed, compile=compile)
        env = stack_frames(env, cfg.frame_stack)
        policy, critic = make_policy_and_critic(env, cfg)
        actor = make_actor(policy)
        self.learning = make_learning(actor, critic, cfg)
        self.batches: Iterator[TensorDictBase] = iter(
            Collector(
                env,
                actor,
                frames_per_batch=self.frames,
                total_frames=-1,
                track_traj_ids=False,
                auto_register_policy_transforms=False,
            )
        )

    def turn(self) -> tuple[float, float]:
        """Processor seconds of one batch and of its update."""
        began = time.process_time()
        batch = next(self.batches)
        collected = time.process_time()
        update(batch, *self.learning, self.cfg)
        return collected - began, time.process_time() - collected


def default_tasks() -> list[str]:
    """Tasks with settings of PPO whose robot has a shipped model."""
    robots = {shipped_card(name)["scene"] for name in shipped_models()}
    return [name for name in PPO_CONFIGS if name.split("/")[0] in robots]


def speeds(task: str, options: Options) -> dict[str, Speed]:
    """Speed in each dynamics, by its name."""
    cfg = Run(**asdict(PPO_CONFIGS[task]), task=task, seed=options.seed)
    if options.num_envs is not None:
        cfg = replace(cfg, num_envs=options.num_envs)
    true = replace(cfg, dynamics="mujoco")
    learners = {MUJOCO: Learner(true), "NeRD": Learner(cfg)}
    if options.compile:
        learners["NeRD, compiled"] = Learner(cfg, compile=True)
    for learner in learners.values():
        learner.turn()
    rounds = [
        {name: learner.turn() for name, learner in learners.items()}
        for _ in range(options.rounds)
    ]
    frames = cfg.num_envs * cfg.horizon
    return {
        name: Speed(
            frames / median(sum(seconds[name]) for seconds in rounds),
            frames / median(seconds[name][0] for seconds in rounds),
            median(sum(seconds[MUJOCO]) / sum(seconds[name]) for seconds in rounds),
        )
        for name in learners
    }


def main(options: Options) -> dict[str, dict[str, Speed]]:
    """Print and return the speeds of every task.

    Raises:
        ValueError: a task without settings of PPO, or a setting out of range.
    """
    expect_at_least(1, rounds=options.rounds, num_envs=options.num_envs or 1)
    unknown = [task for task in options.tasks if task not in default_tasks()]
    if unknown:
        raise ValueError(
            f"expected tasks among {', '.join(default_tasks())}, got {unknown[0]}"
        )
    torch.set_num_threads(1)
    print(
        f"{'task':<22}{'dynamics':<16}{'frames/s':>10}{'collected/s':>13}{'ratio':>7}"
    )
    found = {}
    for task in options.tasks or default_tasks():
        found[task] = speeds(task, options)
        for name, speed in found[task].items():
            rates = f"{speed.frames_per_s:>10,.0f}{speed.collected_per_s:>13,.0f}"
            print(f"{task:<22}{name:<16}{rates}{speed.ratio:>7.2f}", flush=True)
    if options.json is not None:
        results = {
            task: {name: asdict(speed) for name, speed in by_name.items()}
            for task, by_name in found.items()
        }
        write_results(options.json, {"threads": 1, "tasks": results}, options.seed)
    return found


if __name__ == "__main__":
    main(tyro.cli(Options))
