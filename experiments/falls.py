"""Along one policy in MuJoCo, in a model, and in it with noise: falls and progress.

    python experiments/falls.py gymnasium/Ant-v5 runs/policies/gymnasium-Ant-v5 --json FILE

The folder is one of `policies_in_the_model.py`, with its last model and the policy that
learned there. The model's errors are measured on new trajectories along the policy.

Falls: the share of robots on their back, from starts as episodes have. Progress: how much
farther along x the robots of a model are than MuJoCo's, from equal states on the way.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import torch
from learner import run, use_one_thread
from noisy_dynamics import NoisyDynamics, step_errors
from policies_in_the_model import Config as Learning
from policies_in_the_model import pieces_along
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type
from tyro.conf import Positional

from torchrl_nerd import make_env
from torchrl_nerd.checkpoint import load_checkpoint
from torchrl_nerd.envs.actor import Actor
from torchrl_nerd.envs.base import SceneEnv
from torchrl_nerd.evaluation.policy import load_policy, make_actor
from torchrl_nerd.evaluation.results import write_results
from torchrl_nerd.evaluation.rollout_error import interval_of_mean
from torchrl_nerd.evaluation.tables import text_table
from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.robots import make_task
from torchrl_nerd.seeds import fold_in
from torchrl_nerd.settings import expect_at_least, expect_count
from torchrl_nerd.tasks.floating import uprightness


@dataclass(frozen=True)
class Config:
    """Which policy and model, and for how long."""

    name: Positional[str]  # a task whose base moves freely
    folder: Positional[Path]
    noise: tuple[float, ...] = (0.0, 0.5, 1.0)  # shares of the model's own errors
    robots: int = 512
    actions: int = 500
    every: int = 100  # actions of a column; so many are made before progress counts
    ahead: tuple[int, ...] = (1, 10, 20, 50, 100)  # actions after which it is measured
    seed: int = 100
    json: Path | None = None
    """Write the results to this file."""


@torch.no_grad()
def motion(
    env: SceneEnv, actor: Actor, actions: int, start: TensorDictBase | None = None
) -> Iterator[TensorDictBase]:
    """States after each action, from states ``[n]`` or as an episode starts."""
    state = env.reset() if start is None else env.reset(start, set_state=True)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        for _ in range(actions):
            state = env.step(actor(state))["next"]
            yield state


def falls(env: SceneEnv, actor: Actor, actions: int, every: int) -> list[float]:
    """Share of robots on their back, a mean over every so many actions."""
    states = motion(env, actor, actions)
    shares = [(uprightness(state) < 0.0).double().mean() for state in states]
    return [float(part.mean()) for part in torch.stack(shares).split(every)]


def positions(
    env: SceneEnv, actor: Actor, start: TensorDictBase, actions: int
) -> Tensor:
    """Positions along x ``(n, actions)`` after each action from states ``[n]``."""
    states = motion(env, actor, actions, start)
    return torch.stack([state[QPOS][:, 0] for state in states], 1)


def upright_on_the_way(env: SceneEnv, actor: Actor, actions: int) -> TensorDictBase:
    """States ``[n]`` of the robots that still stand after so many actions."""
    *_, last = motion(env, actor, actions)
    return last.select(QPOS, QVEL)[uprightness(last) > 0.0]


def main(cfg: Config) -> None:
    """A row for MuJoCo, and one for each share of noise."""
    use_one_thread()
    torch.manual_seed(cfg.seed)
    learning = Learning(cfg.name)
    task = make_task(learning.name)
    if not task.scene.base.is_floating:
        raise ValueError(f"expected a robot whose base moves freely, got '{cfg.name}'")
    counts = {f"ahead[{i}]": steps for i, steps in enumerate(cfg.ahead)}
    expect_count(1, robots=cfg.robots, actions=cfg.actions, every=cfg.every, **counts)
    for share in cfg.noise:
        expect_at_least(0.0, noise=share)
    models = {int(x.name.split("_")[1]): x for x in cfg.folder.glob("model_*")}
    if not models:
        raise ValueError(f"expected models in {cfg.folder}, got none")
    last = models[max(models)]
    model = cast(NeRD, load_checkpoint(last / "last"))
    actor = make_actor(load_policy(cfg.folder / "policy", task))
    draw, length = fold_in(cfg.seed, 0), learning.length
    data = pieces_along(task, actor, learning.along, length, draw, learning.noise)
    errors, how = step_errors(model, data), (cfg.actions, cfg.every)
    exact = make_env(task, "mujoco", cfg.robots, cfg.seed)
    rows = {"MuJoCo": falls(exact, actor, *how)}
    start = upright_on_the_way(exact, actor, cfg.every)
    if not len(start):
        raise ValueError(
            f"expected robots that stand after {cfg.every} actions, got none"
        )
    more = len(start), cfg.seed
    path = start, max(cfg.ahead)
    there = positions(make_env(task, "mujoco", *more), actor, *path)
    after = torch.tensor(cfg.ahead) - 1
    progress = (there - start[QPOS][:, :1])[:, after].mean(0)
    ahead = {}
    for share in cfg.noise:
        noisy, name = NoisyDynamics(model, errors, share), f"model, noise {share:g}"
        rows[name] = falls(SceneEnv(task, noisy, cfg.robots, cfg.seed), actor, *how)
        found = positions(SceneEnv(task, noisy, *more), actor, *path) - there
        ahead[name] = [
            {"mean": float(x.mean()), "interval": interval_of_mean(x)}
            for x in found[:, after].unbind(1)
        ]
    head = [
        "actions",
        *(f"to {cfg.every * (i + 1)}" for i in range(len(rows["MuJoCo"]))),
    ]
    print(text_table(head, [[n, *(f"{x:.0%}" for x in r)] for n, r in rows.items()]))
    columns = ["farther than MuJoCo, m", *(f"after {k}" for k in cfg.ahead)]
    lines = [[n, *(f"{x['mean']:.3f}" for x in r)] for n, r in ahead.items()]
    print(text_table(columns, lines))
    if cfg.json is not None:
        sizes = torch.linalg.vector_norm(errors.shares, dim=-1).double()
        at = torch.tensor([0.5, 0.9, 0.99], dtype=torch.float64)
        found = {"task": cfg.name, "every": cfg.every, "on_their_back": rows}
        found |= {"after": cfg.ahead, "progress_m": progress.tolist(), "ahead_m": ahead}
        found["errors"] = sizes.quantile(at).tolist()  # shares of the change
        write_results(cfg.json, found, cfg.seed)


if __name__ == "__main__":
    run(main, Config, __doc__)
