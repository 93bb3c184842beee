"""Robots on their back along one policy: in MuJoCo, in a model, and in it with noise.

    python experiments/falls.py gymnasium/Ant-v5 runs/policies/gymnasium-Ant-v5 --json FILE

The folder is one of `policies_in_the_model.py`, with its last model and the policy that
learned there. The model's errors are measured on new trajectories along the policy.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import cast

import torch
from learner import run, use_one_thread
from noisy_dynamics import NoisyDynamics, step_errors
from policies_in_the_model import Config as Learning
from policies_in_the_model import pieces_along, task_of
from torchrl.envs.utils import ExplorationType, set_exploration_type
from tyro.conf import Positional

from torchrl_nerd import make_env
from torchrl_nerd.checkpoint import load_checkpoint
from torchrl_nerd.envs.actor import Actor
from torchrl_nerd.envs.base import SceneEnv
from torchrl_nerd.evaluation.policy import load_policy, make_actor
from torchrl_nerd.evaluation.results import write_results
from torchrl_nerd.evaluation.tables import text_table
from torchrl_nerd.modules.nerd import NeRD
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
    every: int = 100  # actions of a column
    seed: int = 100
    json: Path | None = None
    """Write the results to this file."""


@torch.no_grad()
def falls(env: SceneEnv, actor: Actor, actions: int, every: int) -> list[float]:
    """Share of robots on their back, a mean over every so many actions."""
    state, shares = env.reset(), []
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        for _ in range(actions):
            state = env.step(actor(state))["next"]
            shares.append((uprightness(state) < 0.0).double().mean())
    return [float(part.mean()) for part in torch.stack(shares).split(every)]


def main(cfg: Config) -> None:
    """A row for MuJoCo, and one for each share of noise."""
    use_one_thread()
    torch.manual_seed(cfg.seed)
    learning = Learning(cfg.name)
    task = task_of(learning)
    if not task.scene.base.is_floating:
        raise ValueError(f"expected a robot whose base moves freely, got '{cfg.name}'")
    expect_count(1, robots=cfg.robots, actions=cfg.actions, every=cfg.every)
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
    rows = {
        "MuJoCo": falls(make_env(task, "mujoco", cfg.robots, cfg.seed), actor, *how)
    }
    for share in cfg.noise:
        noisy = NoisyDynamics(model, errors, share)
        env = SceneEnv(task, noisy, cfg.robots, cfg.seed)
        rows[f"model, noise {share:g}"] = falls(env, actor, *how)
    head = [
        "actions",
        *(f"to {cfg.every * (i + 1)}" for i in range(len(rows["MuJoCo"]))),
    ]
    print(text_table(head, [[n, *(f"{x:.0%}" for x in r)] for n, r in rows.items()]))
    if cfg.json is not None:
        sizes = torch.linalg.vector_norm(errors.shares, dim=-1).double()
        at = torch.tensor([0.5, 0.9, 0.99], dtype=torch.float64)
        found = {"task": cfg.name, "every": cfg.every, "on_their_back": rows}
        found["errors"] = sizes.quantile(at).tolist()  # shares of the change
        write_results(cfg.json, found, cfg.seed)


if __name__ == "__main__":
    run(main, Config, __doc__)
