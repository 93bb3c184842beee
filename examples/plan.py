"""Plan in learned dynamics, act in MuJoCo: no policy, TorchRL's own planner.

    python examples/plan.py                      # swing up cart-poles of MuJoCo by NeRD
    python examples/plan.py --dynamics mujoco    # by MuJoCo itself

At every action the planner sets NeRD to MuJoCo's state, tries ``candidates`` sequences of
``horizon`` actions there, and refines the best by the cross-entropy method. An action is
held over four control steps, so 12 of them look 0.8 s ahead. Four cart-poles all end
upright: a mean return of 189.0, of at most 250; without actions -121.8. Six minutes on a
busy core.
"""

import logging
from dataclasses import dataclass

import torch
import tyro
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.modules import CEMPlanner
from tqdm import trange

from torchrl_nerd import make_env
from torchrl_nerd.envs import StatelessEnv
from torchrl_nerd.envs.actor import Actor
from torchrl_nerd.robots.cartpole.tasks import CartpoleSwingup

logging.getLogger("torchrl").setLevel(logging.ERROR)


@dataclass(frozen=True)
class Config:
    """The defaults are for minutes on one core."""

    dynamics: str = "nerd"  # what plans: nerd, mujoco, a checkpoint folder
    num_envs: int = 4  # cart-poles to swing up, all at once
    actions: int = 50  # that are played: 3.3 s
    horizon: int = 12  # actions that the planner looks ahead
    candidates: int = 128  # sequences that it tries in one go
    best: int = 12  # of them, that the next go is drawn around
    rounds: int = 4  # goes
    seed: int = 0


class HeldSwingup(CartpoleSwingup):
    """The swing-up with each action held: a quarter of the decisions."""

    frame_skip = 4
    horizon = CartpoleSwingup.horizon // 4


def make_planner(cfg: Config) -> CEMPlanner:
    """A TorchRL policy that plans.

    Its candidates are a batch dimension of its own, which an env of fixed size refuses:
    `StatelessEnv` takes any batch and sets its envs to the states in it.
    """
    if cfg.best > cfg.candidates:
        raise ValueError(
            f"expected best of at most {cfg.candidates}, the candidates, got {cfg.best}"
        )
    size = cfg.num_envs * cfg.candidates
    model = StatelessEnv(make_env(HeldSwingup(), cfg.dynamics, size))
    return CEMPlanner(model, cfg.horizon, cfg.rounds, cfg.candidates, cfg.best)


@torch.no_grad()
def play(policy: Actor, cfg: Config) -> Tensor:
    """Rewards in MuJoCo, ``(num_envs, actions)``; none after an early end."""
    env = make_env(HeldSwingup(), "mujoco", cfg.num_envs, seed=cfg.seed)
    tensordict, rewards = env.reset(), []
    is_running = torch.ones(cfg.num_envs, dtype=torch.bool)
    for _ in trange(cfg.actions, unit="action"):
        tensordict = env.step(policy(tensordict))["next"]
        rewards.append(torch.where(is_running, tensordict["reward"][:, 0], 0.0))
        is_running &= ~tensordict["done"][:, 0]
    return torch.stack(rewards, 1)


def idle(tensordict: TensorDictBase) -> TensorDictBase:
    """No action at all."""
    return tensordict.set("action", torch.zeros(*tensordict.shape, 1))


def main(cfg: Config) -> None:
    """Return of the planner beside that of doing nothing, from the same starts."""
    torch.manual_seed(cfg.seed)
    for name, policy in (("planned", make_planner(cfg)), ("no action", idle)):
        rewards = play(policy, cfg)
        returns = ", ".join(f"{x:.0f}" for x in rewards.sum(1).tolist())
        print(f"{name:<10} mean return {rewards.sum(1).mean():.1f} ({returns})")
        print(
            f"{'':<10} reward per action at the end {rewards[:, -1].mean():.2f}, of 5"
        )


if __name__ == "__main__":
    main(tyro.cli(Config))
