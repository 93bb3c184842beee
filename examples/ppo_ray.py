"""PPO whose actions are collected by workers of a Ray cluster, which may be lost.

    python examples/ppo_ray.py                      # two workers on this machine
    python examples/ppo_ray.py --address auto --workers 32 --task ant/run

As `examples/ppo.py` in all else. Every worker steps its share of the envs. Where one is
lost, its batch is too, and all begin anew with the policy as it is: no batch is of an
older one.
"""

import logging
import os
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import ppo
import ray
import torch
from ray.exceptions import RayError, RayTaskError
from tensordict import TensorDictBase
from torchrl.collectors.distributed import RayCollector
from torchrl.envs import EnvBase
from torchrl.modules import ProbabilisticActor

from torchrl_nerd import make_env
from torchrl_nerd.envs.frame_stack import stack_frames
from torchrl_nerd.settings import expect_at_least


@dataclass(frozen=True)
class Run(ppo.Run):
    """What to learn, and where actions are collected."""

    workers: int = 2  # one processor each
    address: str = "local"  # HOST:PORT of a cluster; auto: find it; local: this machine


def make_worker_env(cfg: Run, num_envs: int, seed: int) -> EnvBase:
    """A worker's envs; its exploration has a seed of its own, too."""
    # the other processors have other workers
    os.environ.setdefault("NERD_THREADS", "1")
    torch.manual_seed(seed)
    env = make_env(cfg.task, cfg.dynamics, num_envs, seed, compile=cfg.compile)
    return stack_frames(env, cfg.frame_stack)


def make_collector(
    cfg: Run, actor: ProbabilisticActor, frames: int, start: int
) -> RayCollector:
    """Workers with the actor as it is now; each start has other seeds."""
    num_envs = cfg.num_envs // cfg.workers
    seeds = (
        1000 * (cfg.seed + 1) + start * cfg.workers + i for i in range(cfg.workers)
    )
    makers = [partial(make_worker_env, cfg, num_envs, seed) for seed in seeds]
    return RayCollector(
        makers,
        actor,
        frames_per_batch=cfg.num_envs * cfg.horizon,
        total_frames=frames,
        sync=True,
        collector_kwargs={"track_traj_ids": False},
        remote_configs={"num_cpus": 1},
    )


def collect(
    cfg: Run, env: EnvBase, actor: ProbabilisticActor
) -> Iterator[TensorDictBase]:
    """Batches ``[num_envs, horizon]`` of all workers together."""
    expect_at_least(1, workers=cfg.workers)
    if cfg.device != "cpu":
        raise ValueError(f"expected device cpu, as the workers have, got {cfg.device}")
    if cfg.num_envs % cfg.workers:
        raise ValueError(
            f"expected num_envs to be a multiple of the {cfg.workers} workers, "
            f"got {cfg.num_envs}"
        )
    ray.init(cfg.address, log_to_driver=False, logging_level=logging.ERROR)
    done, start, (_, total) = 0, 0, ppo.num_frames(cfg)
    try:
        while done < total:
            collector = make_collector(cfg, actor, total - done, start)
            try:
                collector.update_policy_weights_(actor)
                for batch in collector:
                    yield batch.flatten(0, 1)
                    done += batch.numel()
                    collector.update_policy_weights_(actor)
            except RayTaskError as error:  # the worker's own code
                raise error.cause from None
            except RayError as error:
                start += 1
                print(f"a worker was lost ({type(error).__name__}): all begin anew")
            finally:
                collector.shutdown()
    finally:
        ray.shutdown()


if __name__ == "__main__":
    ppo.main(ppo.parse(Run), collect)
