"""Returns of a policy in several dynamics, from the same initial states.

Protocol of the paper's table 1: whole episodes from the task's reset distribution, the
policy's mean action, the undiscounted sum of rewards. The return difference is
(return - return in the ground truth) / |return in the ground truth|.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from math import isfinite, nan
from pathlib import Path

import torch
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type
from tqdm import tqdm

from torchrl_nerd.checkpoint import shipped_models
from torchrl_nerd.envs import make_env
from torchrl_nerd.envs.actor import Actor
from torchrl_nerd.envs.base import SceneEnv
from torchrl_nerd.envs.frame_stack import frame_stack_of, stack_frames
from torchrl_nerd.evaluation.rollout_error import interval_of_mean
from torchrl_nerd.evaluation.tables import text_table
from torchrl_nerd.files import write_json
from torchrl_nerd.robots import make_task
from torchrl_nerd.tasks import Task

GROUND_TRUTH = "mujoco"
NOTE = (
    "Return difference: to MuJoCo, over the initial states that both ran. "
    "Behind ±: half of the 95% interval. The paper's returns are of another simulator."
)


@dataclass(frozen=True)
class ReturnSummary:
    """Returns of a policy in one dynamics."""

    kind: str  # of the dynamics: ground truth, learned, hybrid or analytic
    model: str  # its name
    episodes: int
    mean: float  # over episodes
    std: float
    interval: float  # half width of the 95% interval of the mean
    difference: float  # to the ground truth over the same initial states, a share
    difference_interval: float  # half width of its interval, from paired differences


@torch.no_grad()
def policy_returns(env: SceneEnv, actor: Actor) -> Tensor:
    """Undiscounted return of one whole episode per env, ``(num_envs,)``, float64.

    An env that ends early earns nothing after its end. Actions are the policy's mean; the
    env stacks as many observations as the policy takes.
    """
    env = stack_frames(env, frame_stack_of(actor))
    tensordict = env.reset()
    is_running = torch.ones(*env.batch_size, 1, dtype=torch.bool, device=env.device)
    returns = torch.zeros(*env.batch_size, 1, dtype=torch.float64, device=env.device)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        for _ in range(env.task.horizon):
            tensordict = env.step(actor(tensordict))["next"]
            returns += torch.where(is_running, tensordict["reward"].double(), 0.0)
            is_running &= ~tensordict["done"]  # (num_envs, 1)
            if not is_running.any():
                break
    return returns.squeeze(-1)


def summarize(
    returns: Tensor, ground_truth: Tensor, kind: str = "learned", model: str = ""
) -> ReturnSummary:
    """Mean, spread and return difference of ``returns (episodes,)``.

    Entry i of them and of those in the ``ground_truth`` began in the same state. The
    difference is over the entries that both have, and NaN where those of the ground truth
    have a mean of zero, as with a policy that has not found any reward yet.

    Raises:
        ValueError: fewer than two episodes.
    """
    both = min(len(returns), len(ground_truth))
    if both < 2:
        raise ValueError(f"expected at least 2 episodes for an interval, got {both}")
    difference = returns[:both] - ground_truth[:both]
    scale = abs(float(ground_truth[:both].mean())) or nan
    return ReturnSummary(
        kind=kind,
        model=model,
        episodes=len(returns),
        mean=float(returns.mean()),
        std=float(returns.std()),
        interval=interval_of_mean(returns),
        difference=float(difference.mean()) / scale,
        difference_interval=interval_of_mean(difference) / scale,
    )


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
    """The same policy from the same initial states in each dynamics, by its name.

    Args:
        task: a task, or its id.
        actor: any TorchRL policy, on ``device``.
        dynamics: what `make_env` takes; MuJoCo, the ground truth, is added if missing.
        episodes: in each dynamics (paper, table 1: 2,048).
        slow_episodes: the first so many of them in dm_control, which steps one by one.
        seed: of the initial states.
        device: where all envs live.
        quiet: no progress bar.

    Raises:
        ValueError: see `summarize` and `make_env`.
    """
    counts = {"dm_control": min(episodes, slow_episodes)}
    envs = {  # all at first: an unknown name is refused before any episode
        name: make_env(task, name, counts.get(name, episodes), seed, device)
        for name in dict.fromkeys((*map(str, dynamics), GROUND_TRUTH))
    }
    progress = tqdm(envs.items(), "dynamics", disable=quiet)
    returns = {name: policy_returns(env, actor) for name, env in progress}
    found = {}
    for name, env in envs.items():
        about = env.dynamics.kind, env.model_name or name
        found[name] = summarize(returns[name], returns[GROUND_TRUTH], *about)
    return found


def transfer_table(summaries: dict[str, ReturnSummary]) -> str:
    """Lines for the terminal: one dynamics each, with 95% intervals."""
    head = "dynamics", "kind", "model", "episodes", "return", "std", "return difference"
    body = []
    for name, s in summaries.items():
        about = name, s.kind, s.model, str(s.episodes)
        mean = f"{s.mean:.1f} ± {s.interval:.1f}"
        shown = round(s.difference, 5) + 0.0  # no minus before a zero
        difference = f"{shown:+.3%} ± {s.difference_interval:.3%}"
        shown = difference if isfinite(s.difference) else "-"
        body.append([*about, mean, f"{s.std:.1f}", shown])
    return f"{text_table(head, body)}\n{NOTE}"


def report_transfer(
    task: str,
    actor: Actor,
    learned_in: str,
    episodes: int,
    seed: int,
    folder: Path,
    device: torch.device | str = "cpu",
) -> dict[str, ReturnSummary]:
    """Print returns in every dynamics and write them to ``folder / "returns.json"``.

    The policy is measured in the dynamics that it ``learned_in``, the shipped model, MuJoCo
    and dm_control, all on ``device``; see `transfer`, which it raises as.
    """
    learned = ("nerd",) if shipped_models(make_task(task).scene) else ()
    everywhere = (learned_in, *learned, "mujoco", "dm_control")
    returns = transfer(task, actor, everywhere, episodes, seed=seed, device=device)
    print(transfer_table(returns))
    write_json(folder / "returns.json", {k: asdict(v) for k, v in returns.items()})
    return returns
