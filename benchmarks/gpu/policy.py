"""Stage e: PPO end to end on the device: frames per second, and returns over time."""

import importlib
import sys
import time
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict

from gpu.stages import Item, Setup
from torchrl_nerd import make_env
from torchrl_nerd.evaluation.policy import make_actor
from torchrl_nerd.robots import PPO_CONFIGS

EXAMPLES = Path(__file__).parents[2] / "examples"
BUDGET = 15.0  # s of a task


def items(setup: Setup) -> dict[str, Item]:
    """One for each task."""
    tasks = setup.pick(("cartpole/swingup", "ant/run"), ("cartpole/swingup",))
    return {f"ppo {task}": lambda task=task: learn(task, setup) for task in tasks}


def learn(task: str, setup: Setup) -> dict[str, Any]:
    """The policy and the update of `examples/ppo.py`, for `BUDGET` seconds.

    Actions are collected by a loop that stays on the device: each env is asked for its end
    once in a batch, by the update.
    """
    sys.path.insert(0, str(EXAMPLES))
    ppo = importlib.import_module("ppo")
    size = setup.pick({"num_envs": 4096}, {"num_envs": 4, "horizon": 4, "minibatch": 8})
    how = vars(PPO_CONFIGS[task]) | size | {"seed": setup.seed}
    cfg = ppo.Run(**how, task=task)
    torch.manual_seed(setup.seed)
    env = make_env(task, "nerd", cfg.num_envs, setup.seed, setup.device)
    policy, critic = ppo.make_policy_and_critic(env, cfg)
    policy, critic = policy.to(setup.device), critic.to(setup.device)
    actor = make_actor(policy)
    advantage, loss, optimizer = ppo.make_learning(actor, critic, cfg)
    setup.wait()
    began, frames, curve = time.perf_counter(), 0, []
    collected, now = 0.0, env.reset()
    while True:
        start = time.perf_counter()
        batch, now = _collect(env, actor, now, cfg.horizon)
        setup.wait()
        collected += time.perf_counter() - start
        reward = float(batch["next", "reward"].mean())
        ppo.update(batch, advantage, loss, optimizer, cfg)
        policy.standardize.fit(batch["observation"])
        setup.wait()
        frames += batch.numel()
        seconds = time.perf_counter() - began
        curve.append({"seconds": seconds, "frames": frames, "reward": reward})
        if seconds > setup.pick(BUDGET, 0.0):
            break
    kept = curve[:: max(1, len(curve) // 50)]
    return {
        "frames_per_s": frames / seconds,
        "collected_per_s": frames / collected,
        "num_envs": cfg.num_envs,
        "first_reward": curve[0]["reward"],
        "last_reward": curve[-1]["reward"],
        "curve": kept,
    }


@torch.no_grad()
def _collect(
    env: Any, actor: Any, now: TensorDict, horizon: int
) -> tuple[TensorDict, TensorDict]:
    """A batch ``[num_envs, horizon]``; resets by mask, whether or not any env is done."""
    steps = []
    for _ in range(horizon):
        now = actor(now)
        after = env._step(now)
        keys = ("observation", "reward", "done", "terminated", "truncated")
        steps.append(now.clone(False).set("next", after.select(*keys)))
        now = env._reset(after.exclude("reward").set("_reset", after["done"]))
    return torch.stack(steps, 1), now  # pyright: ignore
