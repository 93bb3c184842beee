"""Swing up a cart-pole in learned dynamics, then measure the policy in true physics.

    python examples/ppo.py                       # train in NeRD
    python examples/ppo.py --dynamics mujoco     # the same, in MuJoCo: nothing else changes

True physics is measured, never trained on. Policy and figures are written to `--out`.
"""

import logging
from dataclasses import asdict, dataclass
from pathlib import Path
from time import perf_counter

import torch
import tyro
from tensordict import TensorDictBase
from torch import nn
from torch.optim import Adam
from torch.optim.lr_scheduler import LinearLR
from torchrl.collectors import Collector
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE
from tqdm import tqdm

from torchrl_nerd import make_env
from torchrl_nerd.evaluation import plots, policy_transfer
from torchrl_nerd.evaluation.policy import Policy, Standardize, make_actor, mlp, save_policy
from torchrl_nerd.files import write_atomically, write_json

logging.getLogger("torchrl").setLevel(logging.ERROR)


@dataclass(frozen=True)
class PPOConfig:
    """Proximal policy optimisation: Schulman et al., https://arxiv.org/abs/1707.06347."""

    task: str = "cartpole/swingup"
    """what to learn"""
    dynamics: str = "nerd"
    """where to learn it: nerd, mujoco, dm_control or the folder of a checkpoint"""
    seed: int = 0
    """of weights, exploration and starts"""
    total_frames: int = 6_000_000
    """control steps to learn from"""
    num_envs: int = 2048
    """rows stepped together"""
    horizon: int = 32
    """steps of each row between two updates"""
    epochs: int = 4
    """passes over those steps in an update"""
    minibatch: int = 8192
    """steps per gradient"""
    lr: float = 3e-3
    """Adam's step size at the start; falls linearly to zero"""
    gamma: float = 0.99
    """discount per step"""
    lmbda: float = 0.95
    """advantage estimation: 0 trusts the critic, 1 the rewards"""
    clip: float = 0.2
    """how far the probability of an action may move, as a ratio, in one update"""
    max_grad_norm: float = 1.0
    """longer gradients are shortened"""
    widths: tuple[int, ...] = (64, 64)
    """hidden layers of actor and critic"""
    evaluate_every: int = 10
    """updates between two points of the learning curve"""
    episodes: int = 2048
    """in the final evaluation; an eighth of them on dm_control, where each row is slow"""
    out: Path = Path("runs/ppo")
    """folder for policy, curve and figures"""


def train(cfg: PPOConfig) -> tuple[ProbabilisticActor, dict[str, list[float]]]:
    """A policy trained in ``cfg.dynamics`` alone, and its learning curve."""
    env = make_env(cfg.task, cfg.dynamics, num_envs=cfg.num_envs, seed=cfg.seed)
    actor, critic = make_actor_critic(env, cfg.widths)
    advantage = GAE(gamma=cfg.gamma, lmbda=cfg.lmbda, value_network=critic)
    loss = ClipPPOLoss(
        actor, critic, clip_epsilon=cfg.clip, entropy_bonus=False, normalize_advantage=True
    )
    optimizer = Adam(loss.parameters(), lr=cfg.lr)
    frames = cfg.num_envs * cfg.horizon
    updates = cfg.total_frames // frames
    schedule = LinearLR(optimizer, start_factor=1.0, end_factor=0.0, total_iters=updates)
    collector = Collector(
        env,
        actor,
        frames_per_batch=frames,
        total_frames=updates * frames,
        track_traj_ids=False,
    )
