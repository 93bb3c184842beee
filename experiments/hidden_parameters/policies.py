"""Policies that learn in one varied model, tried in MuJoCo on robots drawn anew.

    python -m experiments.hidden_parameters.policies cartpole/swingup \
        --told runs/varied_told/last --json results/varied_policies_cartpole.json

In the varied model every episode is of another robot: the model is told its parameters, the
policy is not. Its rivals learn in the nominal model, and in varied MuJoCo. All have the
same PPO, the same frames and the same test episodes, in MuJoCo, of robots drawn anew.
"""

import sys
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
import tyro
from torch import Tensor

sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))
import ppo

from torchrl_nerd import make_env
from torchrl_nerd.configs import PPOConfig
from torchrl_nerd.envs.actor import Actor
from torchrl_nerd.evaluation.policy import make_actor
from torchrl_nerd.evaluation.policy_transfer import policy_returns, summarize
from torchrl_nerd.evaluation.results import write_results
from torchrl_nerd.evaluation.rollout_error import interval_of_mean
from torchrl_nerd.keys import PARAMETERS
from torchrl_nerd.robots import PPO_CONFIGS, make_task, preset_of
from torchrl_nerd.tasks import Task

PARTS = 3  # of a parameter's range, for the returns in each


@dataclass(frozen=True)
class Options:
    """What to learn, and how."""

    task: tyro.conf.Positional[str]
    told: Path
    """A checkpoint folder of a model that is told the parameters."""
    frames: int = 3_000_000
    """Actions that each policy learns from."""
    history: int = 8
    """Observations that a policy with a history sees, those at the end of an episode."""
    seeds: tuple[int, ...] = (0, 1)
    """Of policies; each way learns once for each."""
    episodes: int = 1024
    """Of the report, in each dynamics."""
    test_seed: int = 900
    """Of the starts and robots of the report; no training uses it."""
    json: Path | None = None
    """Write the results to this file."""


def learn(
    options: Options, task: Task, dynamics: str, history: int, seed: int
) -> Actor:
    """A policy that learned in one dynamics alone."""
    torch.manual_seed(seed)
    known = vars(PPO_CONFIGS.get(options.task, PPOConfig()))
    cfg = ppo.Run(**known, task=options.task, dynamics=dynamics, seed=seed)
    cfg = replace(cfg, total_frames=options.frames, frame_stack=history)
    cfg = replace(cfg, evaluate_every=10**9, episodes=64)  # the report measures
    return make_actor(ppo.train(cfg, task)[0])


def by_part(values: Tensor, own: Tensor, names: list[str]) -> dict[str, list[float]]:
    """Mean of ``values (n,)`` in equal parts of each parameter's drawn values ``own``."""
    found = {}
    for name, column in zip(names, own.unbind(1), strict=True):
        parts = values[column.argsort()].tensor_split(PARTS)
        found[name] = [float(part.mean()) for part in parts]
    return found


def main(options: Options) -> None:
    """Learn in every way, then measure all."""
    nominal = make_task(options.task)
    varied = nominal.vary(preset_of(nominal.scene.name).variation)
    variation = varied.scene.variation
    assert variation is not None
    names = list(variation.ranges)
    told, history = str(options.told), options.history
    ways: dict[str, tuple[Task, str, int]] = {
        "varied model, history": (varied, told, history),
        "varied model": (varied, told, 1),
        "nominal model": (nominal, "nerd", 1),
        "nominal model, history": (nominal, "nerd", history),
        "varied MuJoCo, history": (varied, "mujoco", history),
        "varied MuJoCo": (varied, "mujoco", 1),
    }
    about = options.episodes, options.test_seed
    own = make_env(varied, "mujoco", *about).reset()[PARAMETERS]
    rows: list[dict[str, Any]] = []
    for name, (task, dynamics, seen) in ways.items():
        for seed in options.seeds:
            actor = learn(options, task, dynamics, seen, seed)
            reached = policy_returns(make_env(varied, "mujoco", *about), actor)
            row = {"name": name, "seed": seed, "return": float(reached.mean())}
            row |= {"interval": interval_of_mean(reached)}
            row |= {"by_parameter": by_part(reached, own, names)}
            if dynamics == told:  # the same robots and starts in both
                inside = policy_returns(make_env(varied, told, *about), actor)
                found = summarize(inside, reached)
                row |= {"promised": found.mean, "difference": found.difference}
                row |= {"difference_interval": found.difference_interval}
            rows.append(row)
            print({k: v for k, v in row.items() if k != "by_parameter"}, flush=True)
    if options.json is not None:
        how = asdict(replace(options, json=None)) | {"told": told}
        found = {"configuration": how, "ranges": variation.ranges, "policies": rows}
        write_results(options.json, found, options.test_seed)


if __name__ == "__main__":
    torch.set_num_threads(1)
    main(tyro.cli(Options))
