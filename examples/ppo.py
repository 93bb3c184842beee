"""Learn a task in learned dynamics, then measure the policy in true physics.

    python examples/ppo.py                       # swing up a cart-pole in NeRD
    python examples/ppo.py --dynamics mujoco     # the same in MuJoCo: nothing else changes
    python examples/ppo.py --task ant/run        # any task; its settings: tasks/ppo.py

True physics is measured, never learned from. Policy and figures are written to `--out`.
"""

import logging
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
import tyro
from tensordict import TensorDictBase
from torch import nn
from torch.optim import Adam
from torch.optim.lr_scheduler import LinearLR
from torchrl.collectors import Collector
from torchrl.envs import EnvBase
from torchrl.modules import ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE
from tqdm import tqdm

from torchrl_nerd import make_env
from torchrl_nerd.checkpoint import shipped_models
from torchrl_nerd.envs.actor import Actor
from torchrl_nerd.envs.memory import remember
from torchrl_nerd.evaluation import plots, policy_transfer
from torchrl_nerd.evaluation.policy import Policy, make_actor, mlp, save_policy
from torchrl_nerd.files import write_json
from torchrl_nerd.tasks import Task, make_task
from torchrl_nerd.tasks.ppo import PPO_CONFIGS, PPOConfig

logging.getLogger("torchrl").setLevel(logging.ERROR)


@dataclass(frozen=True)
class Run(PPOConfig):
    """What to learn, where, and with which settings."""

    task: str = "cartpole/swingup"  # what to learn
    dynamics: str = "nerd"  # where: nerd, mujoco, dm_control, a checkpoint folder
    compile: bool = False  # steps in NeRD, see SceneEnv.compile
    seed: int = 0  # of weights, exploration and starts
    evaluate_every: int = 20  # updates between two points of the learning curve
    episodes: int = 2048  # of the final evaluation
    out: Path = Path("runs/ppo")  # folder for policy, numbers and figures


def parse(kind: type[Run] = Run) -> Run:
    """Settings from the command line; the task chooses the defaults of all others."""
    known, _ = tyro.cli(kind, add_help=False, return_unknown_args=True)
    task = known.task
    return tyro.cli(
        kind, default=kind(**vars(PPO_CONFIGS.get(task, PPOConfig())), task=task)
    )


def make_policy_and_critic(env: EnvBase, cfg: Run) -> tuple[Policy, ValueOperator]:
    """Both see observations standardised by all that were met, by random actions first."""
    seen = env.rollout(cfg.horizon, break_when_any_done=False)["observation"]
    size, num_actions = seen.shape[-1], env.action_spec.shape[-1]
    policy = Policy((size, *cfg.widths, num_actions), cfg.std, cfg.memory)
    critic = nn.Sequential(policy.standardize.fit(seen), mlp((size, *cfg.widths, 1)))
    return policy, ValueOperator(critic)


def make_learning(
    actor: ProbabilisticActor, critic: ValueOperator, cfg: Run
) -> tuple[GAE, ClipPPOLoss, Adam]:
    """What `update` takes beside a batch."""
    advantage = GAE(gamma=cfg.gamma, lmbda=cfg.lmbda, value_network=critic)
    loss = ClipPPOLoss(actor, critic, clip_epsilon=cfg.clip, entropy_bonus=False)
    loss.normalize_advantage = True
    return advantage, loss, Adam(loss.parameters(), lr=cfg.lr)


def update(
    batch: TensorDictBase,
    advantage: GAE,
    loss: ClipPPOLoss,
    optimizer: Adam,
    cfg: Run,
) -> None:
    """Several passes over a batch ``[num_envs, horizon]``."""
    batch["next", "reward"] *= 1 - cfg.gamma  # values become means of rewards, not sums
    keys = ("observation", "action", "action_log_prob", "advantage", "value_target")
    steps = advantage(batch).select(*keys).reshape(-1)
    for _ in range(cfg.epochs):
        for rows in torch.randperm(len(steps)).split(cfg.minibatch):
            losses = loss(steps[rows])
            optimizer.zero_grad()
            (losses["loss_objective"] + losses["loss_critic"]).backward()
            nn.utils.clip_grad_norm_(loss.parameters(), 1.0)
            optimizer.step()


def num_frames(cfg: Run) -> tuple[int, int]:
    """Actions in a batch, and in all batches."""
    frames = cfg.num_envs * cfg.horizon
    return frames, cfg.total_frames // frames * frames


def collect(cfg: Run, env: EnvBase, actor: Actor) -> Iterable[TensorDictBase]:
    """Batches ``[num_envs, horizon]`` of an actor that learns between them."""
    frames, total = num_frames(cfg)
    return Collector(
        env,
        actor,
        frames_per_batch=frames,
        total_frames=total,
        track_traj_ids=False,
        auto_register_policy_transforms=False,  # the actor needs none
    )


Collect = Callable[..., Iterable[TensorDictBase]]


def train(
    cfg: Run, task: str | Task | None = None, collect: Collect = collect
) -> tuple[Policy, list[dict[str, float]]]:
    """A policy that met ``cfg.dynamics`` alone, and its returns there and in truth."""
    task = task or cfg.task
    env = make_env(task, cfg.dynamics, cfg.num_envs, seed=cfg.seed, compile=cfg.compile)
    env = remember(env, cfg.memory)
    policy, critic = make_policy_and_critic(env, cfg)
    actor = make_actor(policy)
    advantage, loss, optimizer = make_learning(actor, critic, cfg)
    frames, total = num_frames(cfg)
    schedule = LinearLR(optimizer, 1.0, end_factor=0.0, total_iters=total // frames)
    curve = []
    progress = tqdm(total=total, unit="frame", unit_scale=True)
    for number, batch in enumerate(collect(cfg, env, actor), 1):
        update(batch, advantage, loss, optimizer, cfg)
        policy.standardize.fit(batch["observation"])
        schedule.step()
        progress.update(frames)
        if number % cfg.evaluate_every == 0 or number * frames == total:
            where, seed = [cfg.dynamics], cfg.seed + 1
            episodes = min(256, cfg.episodes)
            returns = policy_transfer.transfer(task, actor, where, episodes, seed=seed)
            means = {name: summary.mean for name, summary in returns.items()}
            progress.set_postfix(means)
            curve.append({"frames": number * frames, **means})
    return policy, curve


def main(cfg: Run, collect: Collect = collect) -> None:
    """Learn in one dynamics, measure in all of them, write down what came out."""
    torch.manual_seed(cfg.seed)
    policy, curve = train(cfg, collect=collect)
    save_policy(policy, cfg.out, {"task": cfg.task, "dynamics": cfg.dynamics})
    plots.plot_learning_curve(curve, cfg.out / "learning_curve.png")

    actor, seed = make_actor(policy), cfg.seed + 2
    scene = make_task(cfg.task).scene
    learned = ("nerd",) if scene.name in shipped_models() else ()
    everywhere = (cfg.dynamics, *learned, "mujoco", "dm_control")
    where = cfg.task, actor, everywhere
    returns = policy_transfer.transfer(*where, cfg.episodes, seed=seed)
    print(policy_transfer.transfer_table(returns))
    write_json(cfg.out / "returns.json", {k: asdict(v) for k, v in returns.items()})
    where = cfg.task, actor, everywhere[:3]
    episodes = policy_transfer.hardest_episode(*where, seed=seed)
    plots.plot_states(episodes, scene, cfg.out / "episode.png")


if __name__ == "__main__":
    main(parse())
