"""What a policy earns in learned and in true dynamics, from the same starts.

Protocol of the paper's table 1: whole episodes from the task's reset distribution, the
policy's mean action, the undiscounted sum of rewards; gap = (learned - true) / true.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_nerd.envs import make_env
from torchrl_nerd.envs.base import SceneEnv

Actor = Callable[[TensorDictBase], TensorDictBase]
"""Any TorchRL policy: reads ``observation``, writes ``action``."""

TRUTH = "mujoco"
NORMAL_95 = 1.96  # half width of a 95% interval, in standard errors
EPISODES = 2048  # paper, table 1


@dataclass(frozen=True)
class ReturnSummary:
    """Returns of a policy in one dynamics.

    | field | meaning |
    |---|---|
    | ``episodes`` | how many |
    | ``mean``, ``std`` | of the returns over episodes |
    | ``interval`` | half width of the 95% interval of the mean |
    | ``gap`` | (mean - true mean) / true mean, over the same starts; 0 for the truth |
    | ``gap_interval`` | half width of its 95% interval, from paired differences |
    """

    episodes: int
    mean: float
    std: float
    interval: float
    gap: float
    gap_interval: float


@torch.no_grad()
def policy_returns(env: SceneEnv, actor: Actor) -> Tensor:
    """Undiscounted return of one whole episode per row, ``(num_envs,)``, float64.

    A row that ends early earns nothing after its end. Actions are the policy's mean.
    """
    tensordict = env.reset()
    is_running = torch.ones(*env.batch_size, 1, dtype=torch.bool, device=env.device)
    returns = torch.zeros(*env.batch_size, 1, dtype=torch.float64, device=env.device)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        for _ in range(env.task.horizon):
            tensordict = env.step(actor(tensordict))["next"]
            returns += torch.where(is_running, tensordict["reward"].double(), 0.0)
            is_running &= ~tensordict["done"]
            if not is_running.any():
                break
    return returns.squeeze(-1)


def summarize(returns: Tensor, true_returns: Tensor) -> ReturnSummary:
    """Mean, spread and gap.

    Args:
        returns: ``(episodes,)``.
        true_returns: ``(true_episodes,)`` in the true dynamics; entry i of both began in
            the same state. The gap is over the entries that both have.

    Raises:
        ValueError: fewer than two episodes, or returns of zero, which have no gap.
    """
    both = min(len(returns), len(true_returns))
    if both < 2:
        raise ValueError(f"expected at least 2 episodes for an interval, got {both}")
    difference = returns[:both] - true_returns[:both]
    true_mean = float(true_returns[:both].mean())
    if true_mean == 0.0:
        raise ValueError("expected a task with rewards: the true mean return is zero")
    return ReturnSummary(
        episodes=len(returns),
        mean=float(returns.mean()),
        std=float(returns.std()),
        interval=_interval(returns),
        gap=float(difference.mean()) / true_mean,
        gap_interval=_interval(difference) / abs(true_mean),
    )


def _interval(samples: Tensor) -> float:
    return float(NORMAL_95 * samples.std() / len(samples) ** 0.5)


def transfer(
    task: str,
    actor: Actor,
    dynamics: Sequence[str | Path] = ("nerd", TRUTH),
    episodes: int | Sequence[int] = EPISODES,
    seed: int = 0,
) -> dict[str, ReturnSummary]:
    """The same policy from the same starts in each dynamics.

    Args:
        task: id of a registered task.
        actor: any TorchRL policy.
        dynamics: what `make_env` takes; the truth, MuJoCo, is added where it is missing.
        episodes: of every dynamics, or one number for each.
        seed: of the starts.

    Returns:
        Summaries by name of the dynamics.

    Raises:
        ValueError: another count of numbers than of dynamics; see also `summarize`.
    """
    names = [str(name) for name in dynamics]
    counts = [episodes] * len(names) if isinstance(episodes, int) else list(episodes)
    if len(counts) != len(names):
        raise ValueError(f"expected {len(names)} numbers of episodes, got {len(counts)}")
    if TRUTH not in names:
        names, counts = [*names, TRUTH], [*counts, max(counts)]
    returns = {
        name: policy_returns(make_env(task, name, num_envs=count, seed=seed), actor)
        for name, count in zip(names, counts, strict=True)
    }
    return {name: summarize(value, returns[TRUTH]) for name, value in returns.items()}


def transfer_table(summaries: dict[str, ReturnSummary]) -> str:
    """Lines for the terminal: one dynamics each, with 95% intervals."""
    rows = [f"{'dynamics':<12}{'episodes':>9}{'return':>18}{'std':>9}{'gap':>20}"]
    for name, s in summaries.items():
        mean = f"{s.mean:.1f} ± {s.interval:.1f}"
        gap = f"{s.gap:+.3%} ± {s.gap_interval:.3%}"
        rows.append(f"{name:<12}{s.episodes:>9}{mean:>18}{s.std:>9.1f}{gap:>20}")
    return "\n".join(rows)
