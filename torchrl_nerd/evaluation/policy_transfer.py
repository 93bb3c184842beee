"""Returns of a policy in several dynamics, from the same starts.

Protocol of the paper's table 1: whole episodes from the task's reset distribution, the
policy's mean action, the undiscounted sum of rewards. The return difference is
(mean - mean in MuJoCo) / mean in MuJoCo.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type
from tqdm import tqdm

from torchrl_nerd.envs import make_env
from torchrl_nerd.envs.actor import Actor
from torchrl_nerd.envs.base import SceneEnv
from torchrl_nerd.envs.frame_stack import frame_stack_of, stack_frames
from torchrl_nerd.tasks import Task

GROUND_TRUTH = "mujoco"
NORMAL_95 = 1.96  # half width of a 95% interval, in standard errors


@dataclass(frozen=True)
class ReturnSummary:
    """Returns of a policy in one dynamics.

    | field | meaning |
    |---|---|
    | ``episodes`` | how many |
    | ``mean``, ``std`` | of the returns over episodes |
    | ``interval`` | half width of the 95% interval of the mean |
    | ``difference`` | relative to the mean in MuJoCo, over the same starts |
    | ``difference_interval`` | half width of its 95% interval, from paired differences |
    """

    episodes: int
    mean: float
    std: float
    interval: float
    difference: float
    difference_interval: float


@torch.no_grad()
def policy_returns(env: SceneEnv, actor: Actor) -> Tensor:
    """Undiscounted return of one whole episode per env, ``(num_envs,)``, float64.

    Rewards after an early end do not count. Actions are the policy's mean; it gets as many
    stacked observations as it was trained with.
    """
    env = stack_frames(env, frame_stack_of(actor))
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


def summarize(returns: Tensor, expected: Tensor) -> ReturnSummary:
    """Mean, spread and difference from MuJoCo.

    Args:
        returns: ``(episodes,)``.
        expected: ``(num_expected,)`` in MuJoCo; entry i of both began in the same state.
            The difference is over the entries that both have.

    Raises:
        ValueError: fewer than two episodes, or a mean return of zero in MuJoCo.
    """
    both = min(len(returns), len(expected))
    if both < 2:
        raise ValueError(f"expected at least 2 episodes for an interval, got {both}")
    difference = returns[:both] - expected[:both]
    mean = float(expected[:both].mean())
    if mean == 0.0:
        raise ValueError(
            "expected a task with rewards: the mean return in MuJoCo is zero"
        )
    return ReturnSummary(
        episodes=len(returns),
        mean=float(returns.mean()),
        std=float(returns.std()),
        interval=_interval(returns),
        difference=float(difference.mean()) / mean,
        difference_interval=_interval(difference) / abs(mean),
    )


def _interval(samples: Tensor) -> float:
    return float(NORMAL_95 * samples.std() / len(samples) ** 0.5)


def transfer(
    task: str | Task,
    actor: Actor,
    dynamics: Sequence[str | Path] = ("nerd", "mujoco", "dm_control"),
    episodes: int = 2048,
    slow_episodes: int = 256,
    seed: int = 0,
    device: torch.device | str = "cpu",
    quiet: bool = True,
) -> dict[str, ReturnSummary]:
    """The same policy from the same starts in each dynamics.

    Args:
        task: a task, or its id.
        actor: any TorchRL policy, on ``device``.
        dynamics: what `make_env` takes; MuJoCo is added where it is missing.
        episodes: in each dynamics (paper, table 1: 2,048).
        slow_episodes: the first so many of them on dm_control, which is slower.
        seed: of the starts.
        device: where all envs live.
        quiet: no progress bar, as by default.

    Returns:
        Summaries by name of the dynamics.

    Raises:
        ValueError: see `summarize` and `make_env`.
    """
    returns, names = {}, dict.fromkeys((*map(str, dynamics), GROUND_TRUTH))
    for name in tqdm(names, "dynamics", disable=quiet):
        rows = min(episodes, slow_episodes) if name == "dm_control" else episodes
        env = make_env(task, dynamics=name, num_envs=rows, seed=seed, device=device)
        returns[name] = policy_returns(env, actor)
    return {
        name: summarize(value, returns[GROUND_TRUTH]) for name, value in returns.items()
    }


def mean_returns(
    task: str | Task,
    actor: Actor,
    dynamics: Sequence[str | Path],
    episodes: int,
    seed: int = 0,
) -> dict[str, float]:
    """The means alone of `transfer`, by name of the dynamics."""
    summaries = transfer(task, actor, dynamics, episodes, seed=seed)
    return {name: summary.mean for name, summary in summaries.items()}


def transfer_table(summaries: dict[str, ReturnSummary]) -> str:
    """Lines for the terminal: one dynamics each, with 95% intervals."""
    width = max(12, *(len(name) + 1 for name in summaries))
    heads = f"{'episodes':>9}{'return':>18}{'std':>9}{'against MuJoCo':>20}"
    rows = [f"{'dynamics':<{width}}{heads}"]
    for name, s in summaries.items():
        mean = f"{s.mean:.1f} ± {s.interval:.1f}"
        difference = f"{s.difference:+.3%} ± {s.difference_interval:.3%}"
        rows.append(
            f"{name:<{width}}{s.episodes:>9}{mean:>18}{s.std:>9.1f}{difference:>20}"
        )
    return "\n".join(rows)
