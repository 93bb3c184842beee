"""What is measured of a trained policy: a table and a JSON file."""

from dataclasses import asdict
from pathlib import Path

from torchrl_nerd.checkpoint import shipped_models
from torchrl_nerd.envs.actor import Actor
from torchrl_nerd.evaluation.policy_transfer import (
    ReturnSummary,
    transfer,
    transfer_table,
)
from torchrl_nerd.files import write_json
from torchrl_nerd.robots import make_task


def report_transfer(
    task: str, actor: Actor, learned_in: str, episodes: int, seed: int, folder: Path
) -> dict[str, ReturnSummary]:
    """Print returns in every dynamics; write them.

    Args:
        task: its id.
        actor: any TorchRL policy.
        learned_in: the dynamics that the policy was trained in; measured beside the
            shipped model, MuJoCo and dm_control.
        episodes: in each, see `transfer`.
        seed: of the initial states.
        folder: gets ``returns.json``.

    Returns:
        Summaries by name of the dynamics.

    Raises:
        ValueError: see `transfer`, or a folder that cannot be written.
    """
    scene = make_task(task).scene
    learned = ("nerd",) if shipped_models(scene) else ()
    everywhere = (learned_in, *learned, "mujoco", "dm_control")
    returns = transfer(task, actor, everywhere, episodes, seed=seed)
    print(transfer_table(returns))
    write_json(folder / "returns.json", {k: asdict(v) for k, v in returns.items()})
    return returns
