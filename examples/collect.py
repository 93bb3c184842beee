"""One process, several processes, several envs in parallel: both dynamics, frames/s.

    python examples/collect.py

`Collector`, `MultiSyncCollector`, `MultiAsyncCollector` and `ParallelEnv` take every
dynamics alike, and in the last rows two at once: one worker steps NeRD, the other MuJoCo.
Envs that step together share each call of the dynamics, so on one device a single env of
many is the simple way; on one busy core none is much faster than another: 3,000 to 7,000
frames/s each. More processes on more cores are not measured.
"""

import logging
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import torch
import tyro
from tensordict import TensorDictBase
from torchrl.collectors import (
    BaseCollector,
    Collector,
    MultiAsyncCollector,
    MultiSyncCollector,
)
from torchrl.envs import ParallelEnv

from torchrl_nerd import make_env
from torchrl_nerd.envs.actor import Actor
from torchrl_nerd.envs.base import SceneEnv
from torchrl_nerd.evaluation.policy import Policy, make_actor
from torchrl_nerd.robots import make_task

logging.getLogger("torchrl").setLevel(logging.ERROR)


@dataclass(frozen=True)
class Config:
    """The defaults are for minutes on one core, most of it the start of processes."""

    task: str = "cartpole/swingup"
    num_envs: int = 256  # of every way
    horizon: int = 32  # steps of every env in a batch
    batches: int = 4  # of which the first is not timed
    seed: int = 0


Maker = partial[SceneEnv]


def makers(cfg: Config, dynamics: Sequence[str]) -> list[Maker]:
    """What each worker calls to make its env; seeds differ."""
    return [
        partial(make_env, cfg.task, name, cfg.num_envs, seed=cfg.seed + worker)
        for worker, name in enumerate(dynamics)
    ]


def make_policy(cfg: Config) -> Actor:
    """Untrained."""
    task = make_task(cfg.task)
    sizes = (task.observation_size, 64, 64, task.controller.num_actions)
    return make_actor(Policy(sizes))


def one_process(cfg: Config, dynamics: Sequence[str]) -> Collector:
    """Of the first dynamics alone."""
    env = makers(cfg, dynamics)[0]()
    frames = cfg.num_envs * cfg.horizon
    return Collector(
        env,
        make_policy(cfg),
        frames_per_batch=frames,
        total_frames=cfg.batches * frames,
        auto_register_policy_transforms=False,
    )


def processes(
    cfg: Config, dynamics: Sequence[str], is_sync: bool = True
) -> BaseCollector:
    """A worker for each dynamics; batches of all of them, or of whoever is ready."""
    collector = MultiSyncCollector if is_sync else MultiAsyncCollector
    frames = cfg.num_envs * cfg.horizon * (len(dynamics) if is_sync else 1)
    return collector(
        makers(cfg, dynamics),
        make_policy(cfg),
        frames_per_batch=frames,
        total_frames=cfg.batches * frames,
        auto_register_policy_transforms=False,
    )


def parallel_envs(cfg: Config, dynamics: Sequence[str]) -> Collector:
    """One collector whose env steps an env in each of several processes."""
    frames = len(dynamics) * cfg.num_envs * cfg.horizon
    return Collector(
        ParallelEnv(len(dynamics), makers(cfg, dynamics)),
        make_policy(cfg),
        frames_per_batch=frames,
        total_frames=cfg.batches * frames,
        auto_register_policy_transforms=False,
    )


def batches(collector: BaseCollector) -> Iterator[TensorDictBase]:
    """All batches; then the processes end."""
    try:
        for batch in collector:
            yield batch.clone()  # workers write the next into the same memory
    finally:
        collector.shutdown()


def measure(name: str, dynamics: Sequence[str], collector: BaseCollector) -> None:
    """Print the shape of a batch and the frames per second after the first one."""
    arriving = batches(collector)
    first, began = next(arriving), time.perf_counter()
    count = sum(batch.numel() for batch in arriving)
    rate = count / (time.perf_counter() - began)
    shape = "x".join(map(str, first.shape))
    print(f"{name:<22}{' + '.join(dynamics):<18}{shape:<12}{rate:>12,.0f} frames/s")


def main(cfg: Config) -> None:
    """Every way, with learned dynamics, with MuJoCo, and with one of each."""
    torch.manual_seed(cfg.seed)
    for name in ("nerd", "mujoco"):
        measure("Collector", [name], one_process(cfg, [name]))
    for pair in (("nerd", "nerd"), ("mujoco", "mujoco"), ("nerd", "mujoco")):
        measure("MultiSyncCollector", pair, processes(cfg, pair))
        measure("MultiAsyncCollector", pair, processes(cfg, pair, is_sync=False))
        measure("ParallelEnv", pair, parallel_envs(cfg, pair))


if __name__ == "__main__":
    main(tyro.cli(Config))
