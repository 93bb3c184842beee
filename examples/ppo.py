"""Learn a task in learned dynamics, then measure the policy in MuJoCo.

    python examples/ppo.py                     # swing up a cart-pole in learned dynamics
    python examples/ppo.py --dynamics mujoco   # the same in MuJoCo; --task for another task

MuJoCo only measures. Policy, learning curve and returns are written to `--out`.
"""

import logging
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
import tyro
from tensordict import TensorDictBase
from torch import nn
from torch.optim import Adam, lr_scheduler
from torchrl.collectors import Collector
from torchrl.envs import EnvBase
from torchrl.modules import ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE
from tqdm import tqdm

from torchrl_nerd import make_env
from torchrl_nerd.configs import PPOConfig
from torchrl_nerd.envs.actor import Actor
from torchrl_nerd.envs.frame_stack import stack_frames
from torchrl_nerd.evaluation.policy import Policy, make_actor, mlp, save_policy
from torchrl_nerd.evaluation.policy_transfer import report_transfer, transfer
from torchrl_nerd.files import write_json
from torchrl_nerd.robots import PPO_CONFIGS
from torchrl_nerd.settings import expect_at_least
from torchrl_nerd.tasks import Task

logging.getLogger("torchrl").setLevel(logging.ERROR)


@dataclass(frozen=True)
class Run(PPOConfig):
    """What to learn, where, and with which settings."""

    task: str = "cartpole/swingup"  # what to learn
    dynamics: str = "nerd"  # where: nerd, mujoco, dm_control, a checkpoint folder
    device: str = "cpu"  # of env, policy and learning
    compile: bool = False  # steps in NeRD, see SceneEnv.compile
    seed: int = 0  # of weights, exploration and starts
    evaluate_every: int = 20  # updates between two points of the learning curve
    episodes: int = 2048  # of the final evaluation
    out: Path = Path("runs/ppo")  # folder for policy and numbers


def parse(kind: type[Run] = Run) -> Run:
    """Settings from the command line; the task chooses the defaults of all others."""
    task = tyro.cli(kind, add_help=False, return_unknown_args=True)[0].task
    defaults = vars(PPO_CONFIGS.get(task, PPOConfig()))
    return tyro.cli(kind, default=kind(**defaults, task=task))


def make_policy_and_critic(env: EnvBase, cfg: Run) -> tuple[Policy, ValueOperator]:
    """Both see observations standardised by all seen so far, at first by random actions."""
    policy = Policy.for_env(env, cfg.horizon, cfg.widths, cfg.std, cfg.frame_stack)
    critic = nn.Sequential(policy.standardize, mlp((policy.sizes[0], *cfg.widths, 1)))
    return policy, ValueOperator(critic.to(env.device))


def make_learning(
    actor: ProbabilisticActor, critic: ValueOperator, cfg: Run
) -> tuple[GAE, ClipPPOLoss, Adam]:
    """What `update` takes beside a batch."""
    how = {"value_network": critic, "device": next(critic.parameters()).device}
    advantage = GAE(gamma=cfg.gamma, lmbda=cfg.lmbda, **how)
    loss = ClipPPOLoss(actor, critic, clip_epsilon=cfg.clip, entropy_bonus=False)
    loss.normalize_advantage = True
    return advantage, loss, Adam(loss.parameters(), lr=cfg.lr)


def update(
    batch: TensorDictBase, advantage: GAE, loss: ClipPPOLoss, optimizer: Adam, cfg: Run
) -> None:
    """Several passes over a batch ``[num_envs, horizon]``."""
    batch["next", "reward"] *= 1 - cfg.gamma  # values become means of rewards, not sums
    keys = ("observation", "action", "action_log_prob", "advantage", "value_target")
    steps = advantage(batch).select(*keys).reshape(-1)
    for _ in range(cfg.epochs):
        order = torch.randperm(len(steps), device=steps.device)
        for chosen in order.split(cfg.minibatch):
            losses = loss(steps[chosen])
            optimizer.zero_grad()
            (losses["loss_objective"] + losses["loss_critic"]).backward()
            nn.utils.clip_grad_norm_(loss.parameters(), 1.0)
            optimizer.step()


def num_frames(cfg: Run) -> tuple[int, int]:
    """Actions in a batch, and in all batches; less than a batch is refused."""
    expect_at_least(n := cfg.num_envs * cfg.horizon, total_frames=cfg.total_frames)
    return n, cfg.total_frames // n * n


def collect(cfg: Run, env: EnvBase, actor: Actor) -> Iterable[TensorDictBase]:
    """Batches ``[num_envs, horizon]`` of an actor that learns between them."""
    frames, total = num_frames(cfg)
    how = {"frames_per_batch": frames, "total_frames": total, "track_traj_ids": False}
    how["auto_register_policy_transforms"] = False  # the actor needs none
    return Collector(env, actor, **how)


def train(
    cfg: Run, task: str | Task | None = None, collect: Callable = collect
) -> tuple[Policy, list[dict[str, float]]]:
    """A policy that learned in ``cfg.dynamics`` alone, its returns there and in MuJoCo."""
    task = task or cfg.task
    how = {"device": cfg.device, "compile": cfg.compile}
    env = make_env(task, cfg.dynamics, cfg.num_envs, cfg.seed, **how)
    env = stack_frames(env, cfg.frame_stack)
    policy, critic = make_policy_and_critic(env, cfg)
    actor = make_actor(policy)
    advantage, loss, optimizer = make_learning(actor, critic, cfg)
    frames, total = num_frames(cfg)
    schedule = lr_scheduler.LinearLR(optimizer, 1.0, 0.0, total // frames)
    curve, progress = [], tqdm(total=total, unit="frame", unit_scale=True)
    for number, batch in enumerate(collect(cfg, env, actor), 1):
        update(batch, advantage, loss, optimizer, cfg)
        policy.standardize.fit(batch["observation"])
        schedule.step()
        progress.update(frames)
        if number % cfg.evaluate_every == 0 or number * frames == total:
            how = {"seed": cfg.seed + 1, "device": cfg.device}
            found = transfer(task, actor, [cfg.dynamics], min(256, cfg.episodes), **how)
            means = {name: returns.mean for name, returns in found.items()}
            progress.set_postfix(means)
            curve.append({"frames": number * frames, **means})
    return policy, curve


def main(cfg: Run, collect: Callable = collect) -> None:
    """Learn in one dynamics, measure in all of them, write down what came out."""
    torch.manual_seed(cfg.seed)
    policy, curve = train(cfg, collect=collect)
    save_policy(policy, cfg.out, asdict(cfg))
    write_json(cfg.out / "learning_curve.json", {"curve": curve})
    how = cfg.dynamics, cfg.episodes, cfg.seed + 2, cfg.out, cfg.device
    report_transfer(cfg.task, make_actor(policy), *how)
    print(f"Policy: {cfg.out}. Video: nerd play {cfg.task} --policy {cfg.out}")


if __name__ == "__main__":
    main(parse())
