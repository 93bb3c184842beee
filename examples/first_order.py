"""Learn a policy by gradients through the dynamics, and measure it in MuJoCo.

    python examples/first_order.py
    python examples/first_order.py --start runs/ppo --compile   # go on from a PPO policy

MuJoCo has no gradients; learned, hybrid and analytic dynamics have. The return of a window
is differentiated with respect to the policy through reward, state, torque and action of
every step, without a critic or a score function; then the window moves on along the
episode.
"""

import logging
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
import tyro
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.optim import Adam
from torch.optim.lr_scheduler import LinearLR
from tqdm import trange

from torchrl_nerd import NeRDEnv, make_env
from torchrl_nerd.checkpoint import from_pretrained
from torchrl_nerd.configs import PPOConfig
from torchrl_nerd.envs.frame_stack import append_frame, stack_frames
from torchrl_nerd.evaluation.policy import Policy, load_policy, make_actor, save_policy
from torchrl_nerd.evaluation.policy_transfer import (
    ReturnSummary,
    policy_returns,
    summarize,
    transfer,
    transfer_table,
)
from torchrl_nerd.files import write_json
from torchrl_nerd.robots import PPO_CONFIGS, make_task

logging.getLogger("torchrl").setLevel(logging.ERROR)


@dataclass(frozen=True)
class Config:
    """The defaults are for minutes on one core."""

    task: str = "franka/reach"  # what to learn
    dynamics: str = "nerd"  # what to learn in: nerd, hybrid, analytic, a model's name
    start: Path | None = None  # folder of a policy to go on from, as PPO leaves it
    compile: bool = False  # steps and their gradients: minutes at first, then faster
    num_envs: int = 64  # that it learns from together
    window: int = 16  # actions that the gradient goes through
    episode: int = 128  # actions before all envs begin anew
    updates: int = 300  # gradient steps, one a window
    lr: float = 3e-3  # Adam's step size at the start; falls linearly to almost zero
    evaluate_every: int = 25  # updates between two points of the learning curve
    episodes: int = 256  # of the evaluation
    seed: int = 0
    out: Path = Path("runs/first_order")  # folder for policy and returns


def make_policy(cfg: Config, env: NeRDEnv) -> Policy:
    """The given one, or one that knows the observations of random actions alone."""
    if cfg.start is not None:
        return load_policy(cfg.start, env.task)
    ppo = PPO_CONFIGS.get(cfg.task, PPOConfig())
    seen = stack_frames(env, ppo.frame_stack)
    return Policy.for_env(seen, cfg.episode, ppo.widths, frame_stack=ppo.frame_stack)


def measure(cfg: Config, policy: Policy) -> ReturnSummary:
    """Its return where it learns, from starts that the final evaluation does not have."""
    env = make_env(cfg.task, cfg.dynamics, min(256, cfg.episodes), seed=cfg.seed + 1)
    returns = policy_returns(env, make_actor(policy))
    return summarize(returns, returns)


def train(cfg: Config, measure: Callable = measure) -> tuple[Policy, list[float]]:
    """The policy with the largest return, and the mean reward of every window."""
    model = from_pretrained(cfg.dynamics, make_task(cfg.task).scene).requires_grad_(
        False
    )
    env = NeRDEnv(cfg.task, model, cfg.num_envs, cfg.seed, differentiable=True)
    policy = make_policy(cfg, env)
    if cfg.compile:
        env.compile()
    optimizer = Adam(policy.mlp.parameters(), cfg.lr)
    schedule = LinearLR(optimizer, 1.0, end_factor=0.02, total_iters=cfg.updates)
    best = measure(cfg, policy)
    keep(cfg, policy)
    windows = max(1, cfg.episode // cfg.window)
    turn = torch.arange(cfg.num_envs) % windows  # each update sees all of an episode
    rewards: list[float] = []
    now, recent = env.reset(), None
    progress = trange(1, cfg.updates + 1, unit="window")
    for update in progress:
        reward, recent, ended = window_reward(env, policy, now, recent, cfg.window)
        optimizer.zero_grad()
        (-reward).backward()
        norm = nn.utils.clip_grad_norm_(policy.mlp.parameters(), 1.0)
        if norm.isfinite():
            optimizer.step()
        schedule.step()
        rewards.append(float(reward.detach()))
        ended |= (update + turn) % windows == 0
        now, recent = go_on(env, recent, policy.frame_stack, ended)
        if update % cfg.evaluate_every == 0 or update == cfg.updates:
            earned = measure(cfg, policy)
            progress.set_postfix(earned=earned.mean, best=best.mean)
            if earned.mean > best.mean:
                best = earned
                keep(cfg, policy)
            elif earned.mean + earned.interval < best.mean:
                step_back(policy, load_policy(cfg.out), optimizer)
    return load_policy(cfg.out), rewards


def keep(cfg: Config, policy: Policy) -> None:
    """Write down the best one so far."""
    save_policy(policy, cfg.out, asdict(cfg))


def step_back(policy: Policy, best: Policy, optimizer: Adam) -> None:
    """Continue from the best policy at half the step size.

    Where motion is nearly chaotic gradients say little, and a worse policy moves so more.
    """
    policy.load_state_dict(best.state_dict())
    optimizer.state.clear()
    for group in optimizer.param_groups:
        group["lr"] *= 0.5


def window_reward(
    env: NeRDEnv, policy: Policy, now: TensorDictBase, recent: Tensor | None, steps: int
) -> tuple[Tensor, Tensor | None, Tensor]:
    """Mean reward of the policy's mean actions, with gradients, and what it saw last.

    An env that ended earns nothing more; the last value is which did, ``(num_envs,)``.

    Args:
        env: learned dynamics that are differentiable.
        policy: what acts.
        now: what the env gave last.
        recent: ``(num_envs, frame_stack * D)``, what it saw last; None at first.
        steps: how many actions.
    """
    total, runs = torch.zeros(()), torch.ones(*env.batch_size, 1, dtype=torch.bool)
    for _ in range(steps):
        recent = append_frame(recent, now["observation"], policy.frame_stack)
        mean, _ = policy(recent)
        if mean.requires_grad:
            mean.register_hook(bound_gradients)
        now = env.step(now.set("action", mean.tanh()))["next"]
        total = total + (runs * now["reward"]).mean()
        runs = runs & ~now["done"]
    ended = ~runs.squeeze(-1)
    return total / steps, None if recent is None else recent.detach(), ended


def bound_gradients(gradient: Tensor, times: float = 4.0) -> Tensor:
    """Gradients ``(num_envs, num_actions)``, none longer than ``times`` the median one.

    Where motion is nearly chaotic its gradient grows with every step that it goes back
    through, and one such env would point the whole batch its way. What is no number
    counts nothing.
    """
    gradient = gradient.nan_to_num(0.0, 0.0, 0.0)
    length = gradient.norm(dim=-1, keepdim=True)
    bound = times * length.median()
    return gradient * (bound / length.clamp_min(1e-30)).clamp_max(1.0)


def go_on(
    env: NeRDEnv, recent: Tensor | None, frame_stack: int, ended: Tensor
) -> tuple[TensorDictBase, Tensor | None]:
    """Where the window ended, without its graph; ``ended (num_envs,)`` begin anew."""
    state = env.state.detach()
    if ended.any():
        env.reset()
        state = env.state.where(ended, state)
    now = env.reset(state, set_state=True)
    if recent is not None:
        first = append_frame(None, now["observation"], frame_stack)
        recent = torch.where(ended[:, None], first, recent)
    return now, recent


def main(cfg: Config) -> None:
    """Learn through the dynamics, measure in them and in MuJoCo."""
    torch.manual_seed(cfg.seed)
    policy, _ = train(cfg)
    where = [cfg.dynamics, "mujoco"]
    actor = make_actor(policy)
    returns = transfer(cfg.task, actor, where, cfg.episodes, seed=cfg.seed + 2)
    print(transfer_table(returns))
    write_json(cfg.out / "returns.json", {k: asdict(v) for k, v in returns.items()})


if __name__ == "__main__":
    main(tyro.cli(Config))
