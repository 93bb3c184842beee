"""Policies in the model that they learned in alone, and in MuJoCo: the paper's table 1.

    for seed in 0 1 2; do
      python experiments/time_to_policy.py ant/run --dynamics ant ant-mlp --wanted 0 \
          --seed $seed --out runs/seed_$seed
    done
    python experiments/own_policies.py ant/run --policies runs/seed_*/ant-run \
        --json results/own_policies_ant_run.json

Of every dynamics that is not MuJoCo the last policy of each folder plays whole episodes, in
both from the same starts. Return differences are paired, as shares of the return in MuJoCo.
"""

from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from statistics import mean
from typing import Any

from learner import run, use_one_thread
from tyro.conf import Positional
from unmet_policies import found_policies

from torchrl_nerd.evaluation.policy import CARD, load_policy, make_actor
from torchrl_nerd.evaluation.policy_transfer import GROUND_TRUTH, transfer
from torchrl_nerd.evaluation.results import write_results
from torchrl_nerd.evaluation.tables import text_table
from torchrl_nerd.files import read_json
from torchrl_nerd.robots import make_task

PAPER = {  # return difference, table 1 and appendix C.3
    "cartpole/swingup": 0.0001,
    "ant/run": 0.0425,
    "ant/spin": 0.1721,
    "ant/spin_track": 0.0247,
    "anymal/forward": -0.0002,
    "anymal/sideways": -0.0007,
    "franka/reach": 0.0202,
    "franka/reach_torque": 0.0011,
}


@dataclass(frozen=True)
class Config:
    """Which policies, and how often they play."""

    task: Positional[str]
    policies: tuple[Path, ...]  # folders of DYNAMICS/NUMBER, one a seed
    episodes: int = 2048  # of each policy in both
    seed: int = 500
    json: Path | None = None
    """Write the results to this file."""


def last_policies(folder: Path) -> list[Path]:
    """Of each dynamics but MuJoCo's.

    Raises:
        ValueError: none there.
    """
    last = {policy.parent: policy for policy in found_policies(folder)}
    own = [
        policy
        for policy in last.values()
        if not read_json(policy / CARD)["learned_in"].startswith(GROUND_TRUTH)
    ]
    if not own:
        raise ValueError(f"expected policies of a model in {folder}, found none")
    return own


def play(cfg: Config, policy: Path) -> dict[str, Any]:
    """Returns of a policy where it learned and in MuJoCo."""
    use_one_thread()
    task, name = make_task(cfg.task), read_json(policy / CARD)["learned_in"]
    actor = make_actor(load_policy(policy, task))
    found = transfer(task, actor, (name,), cfg.episodes, seed=cfg.seed)
    own, reached = found[name], found[GROUND_TRUTH]
    row = {"model": name, "kind": own.kind, "return": reached.mean, "std": reached.std}
    row |= {"promised": own.mean, "promised_std": own.std}
    return row | {"share": own.difference, "interval": own.difference_interval}


def summaries(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Of each model: means over its policies, and the largest absolute difference."""
    found = []
    for name in dict.fromkeys(row["model"] for row in rows):
        own = [row for row in rows if row["model"] == name]
        returns = {key: mean(row[key] for row in own) for key in ("return", "promised")}
        shares = [row["share"] for row in own]
        about = {"model": name, "kind": own[0]["kind"], "policies": len(own)}
        gap = returns["promised"] - returns["return"]
        both = {"difference": gap / abs(returns["return"])}
        found.append(about | returns | both | {"worst": max(shares, key=abs)})
    return found


def main(cfg: Config) -> None:
    """All policies, two at a time, then a line for each model."""
    policies = [policy for folder in cfg.policies for policy in last_policies(folder)]
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:
        played = [pool.submit(play, cfg, policy) for policy in policies]
        rows = [each.result() for each in played]
    models, paper = summaries(rows), PAPER.get(cfg.task)
    head = "model", "kind", "policies", "return", "promised", "difference", "largest"
    body = [
        [m["model"], m["kind"], str(m["policies"])]
        + [f"{m[key]:.1f}" for key in ("return", "promised")]
        + [f"{m[key]:+.2%}" for key in ("difference", "worst")]
        for m in models
    ]
    print(text_table(head, body))
    if cfg.json is not None:
        found = {"task": cfg.task, "episodes": cfg.episodes, "paper": paper}
        write_results(cfg.json, found | {"models": models, "policies": rows}, cfg.seed)


if __name__ == "__main__":
    run(main, Config, __doc__)
