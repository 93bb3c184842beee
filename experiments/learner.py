"""What studies of policies share: PPO that may change envs, its time, a command line.

PPO keeps policy, critic and step size from env to env.
"""

import copy
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
import tyro
from torchrl.envs import EnvBase

sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))
import ppo

from torchrl_nerd.envs.actor import Actor
from torchrl_nerd.evaluation.policy import make_actor
from torchrl_nerd.files import check_writable


def run(main: Callable[[Any], None], settings: type, about: str | None) -> None:
    """Call ``main`` with the settings of the command line; bad ones end in a sentence."""
    try:
        cfg = tyro.cli(settings, description=about)
        if cfg.json is not None:  # refuse it before any work
            check_writable(cfg.json)
        main(cfg)
    except (ValueError, OSError) as error:
        sys.exit(str(error))


def use_one_thread() -> None:
    """Of this process, for torch and for MuJoCo."""
    torch.set_num_threads(1)
    os.environ["NERD_THREADS"] = "1"


def processor_time() -> float:
    """Of this process and of compilers that it called, s; on a free core wall time."""
    return sum(os.times()[:4])


@dataclass
class Clock:
    """Time of each kind of work, s."""

    read: Callable[[], float] = processor_time
    seconds: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._began = self.read()

    def note(self, kind: str) -> None:
        """Count the time since the last note, or the beginning, as that of a kind."""
        now = self.read()
        self.seconds[kind] = self.seconds.get(kind, 0.0) + now - self._began
        self._began = now

    def spent(self) -> float:
        """All of it so far, without what is no part of the method."""
        return sum(s for kind, s in self.seconds.items() if kind != "watching")


class Learner:
    """Learns in any env, one after another, with the same policy, critic and step size.

    Args:
        cfg: settings of PPO; the step size falls to zero over all of its frames.
        env: whose specs policy and critic have; it need not be one that is learned in.
    """

    def __init__(self, cfg: ppo.Run, env: EnvBase) -> None:
        self.cfg = cfg
        self.policy, critic = ppo.make_policy_and_critic(env, cfg)
        self.actor = make_actor(self.policy)
        self.parts = ppo.make_learning(self.actor, critic, cfg)
        self.batch = cfg.num_envs * cfg.horizon
        self.updates, self.done = max(1, cfg.total_frames // self.batch), 0

    def on_the_processor(self) -> Actor:
        """Its policy, to act in MuJoCo: itself where it is there."""
        if self.policy.standardize.mean.device.type == "cpu":
            return self.actor
        return make_actor(copy.deepcopy(self.policy).cpu())

    def learn(self, env: EnvBase, share: float) -> dict[str, float]:
        """A share of all frames in an env; of the last batch: reward, share of failures."""
        count, optimizer = max(1, round(share * self.updates)), self.parts[2]
        how, found = replace(self.cfg, total_frames=count * self.batch), {}
        for batch in ppo.collect(how, env, self.actor):
            found = {"reward": float(batch["next", "reward"].mean())}
            found["failed"] = float(batch["next", "terminated"].float().mean())
            for group in optimizer.param_groups:
                left = 1.0 - self.done / self.updates
                group["lr"] = self.cfg.lr * max(0.0, left)
            ppo.update(batch, *self.parts, self.cfg)
            self.policy.standardize.fit(batch["observation"])
            self.done += 1
        return found
