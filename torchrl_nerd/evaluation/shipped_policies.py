"""Policies that come with the package, learned in shipped models: ``make policies``."""

from pathlib import Path

from torchrl_nerd.evaluation.policy import CARD
from torchrl_nerd.files import read_json

POLICIES = Path(__file__).parents[1] / "policies"


def shipped_policies() -> dict[str, Path]:
    """Task id -> folder of its policy, see `load_policy`."""
    folders = sorted(card.parent for card in POLICIES.glob(f"*/{CARD}"))
    return {read_json(folder / CARD)["task"]: folder for folder in folders}


def shipped_policy(task: str) -> Path:
    """The folder of a task's policy.

    Raises:
        ValueError: none is shipped for that task.
    """
    policies = shipped_policies()
    if task not in policies:
        names = ", ".join(policies)
        raise ValueError(
            f"no policy of '{task}' is shipped, only of {names}: expected a folder that "
            "examples/ppo.py wrote"
        )
    return policies[task]
