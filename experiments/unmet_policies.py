"""Policies that did not learn in a model, in it and in MuJoCo, from the same starts.

    python experiments/unmet_policies.py ant/run --policies runs/time_to_policy/ant-run \
        --json results/unmet_policies_ant_run.json

`time_to_policy.py` leaves policies that learned in several dynamics, from untrained to
trained, in ``DYNAMICS/NUMBER``. Each plays whole episodes in every model but that which it
learned in. Return differences are paired, as shares of the policy's own return in MuJoCo
and of the best policy's: one that falls at once earns nearly nothing to be a share of.
"""

from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from statistics import mean
from typing import Any

from learner import run, use_one_thread
from tyro.conf import Positional

from torchrl_nerd.checkpoint import model_name, shipped_models
from torchrl_nerd.evaluation.policy import CARD, load_policy, make_actor
from torchrl_nerd.evaluation.policy_transfer import GROUND_TRUTH, transfer
from torchrl_nerd.evaluation.results import write_results
from torchrl_nerd.evaluation.tables import text_table
from torchrl_nerd.files import read_json
from torchrl_nerd.robots import make_task


@dataclass(frozen=True)
class Config:
    """Which policies, and where they play."""

    task: Positional[str]
    policies: Path  # folder of DYNAMICS/NUMBER
    models: tuple[
        str, ...
    ] = ()  # none: all that are shipped for the robot, and analytic
    episodes: int = 128  # of each policy in each model
    seed: int = 500
    json: Path | None = None
    """Write the results to this file."""

    def names(self) -> tuple[str, ...]:
        """Of the models."""
        shipped = shipped_models(make_task(self.task).scene)
        return self.models or (*shipped, "analytic")


def found_policies(folder: Path) -> list[Path]:
    """``DYNAMICS/NUMBER``, by the dynamics and the number.

    Raises:
        ValueError: none there.
    """
    found = [x.parent for x in folder.glob("*/*/policy.json")]
    if not found:
        raise ValueError(f"expected policies DYNAMICS/NUMBER in {folder}, found none")
    return sorted(found, key=lambda x: (x.parent.name, int(x.name)))


def play(cfg: Config, policy: Path) -> list[dict[str, Any]]:
    """A row for each model that the policy did not learn in."""
    use_one_thread()
    task, learned_in = make_task(cfg.task), read_json(policy / CARD)["learned_in"]
    own = model_name(learned_in, task.scene)
    named = {name: model_name(name, task.scene) for name in cfg.names()}
    unmet = [name for name, model in named.items() if model != own]
    actor = make_actor(load_policy(policy, task))
    found = transfer(task, actor, unmet, cfg.episodes, seed=cfg.seed)
    reached = found[GROUND_TRUTH].mean
    about = {"learned_in": learned_in, "number": int(policy.name), "return": reached}
    shown = (
        {"model": name, "kind": s.kind, "difference": s.mean - reached}
        | {"share": s.difference, "interval": s.difference_interval}
        for name, s in found.items()
        if name != GROUND_TRUTH
    )
    return [about | row for row in shown]


def summaries(rows: list[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """Of each model: mean and largest absolute difference, both shares."""
    best = max(abs(row["return"]) for row in rows)
    for name in dict.fromkeys(row["model"] for row in rows):
        own = [row for row in rows if row["model"] == name]
        of_own = [abs(row["share"]) for row in own]
        of_best = [abs(row["difference"]) / best for row in own]
        yield {
            "model": name,
            "kind": own[0]["kind"],
            "policies": len(own),
            "mean": mean(of_own),
            "worst": max(of_own),
            "mean_of_best": mean(of_best),
            "worst_of_best": max(of_best),
        }


def main(cfg: Config) -> None:
    """All policies, two at a time, then a line for each model."""
    policies = found_policies(cfg.policies)
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:
        played = [pool.submit(play, cfg, policy) for policy in policies]
        rows = [row for each in played for row in each.result()]
    models = list(summaries(rows))
    head = "model", "kind", "policies", "mean", "worst", "of the best", "worst"
    body = [
        [f"{x:.1%}" if isinstance(x, float) else str(x) for x in m.values()]
        for m in models
    ]
    print(text_table(head, body))
    if cfg.json is not None:
        found = {"task": cfg.task, "episodes": cfg.episodes, "models": models}
        write_results(cfg.json, found | {"policies": rows}, cfg.seed)


if __name__ == "__main__":
    run(main, Config, __doc__)
