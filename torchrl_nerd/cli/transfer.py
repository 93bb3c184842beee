"""``nerd transfer``: returns of a policy in learned dynamics and in the ground truth."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from torchrl_nerd.cli.command import MeasuringCommand
from torchrl_nerd.cli.options import Positional
from torchrl_nerd.envs import make_env
from torchrl_nerd.envs.actor import Actor
from torchrl_nerd.evaluation.policy import load_policy, make_actor, shipped_policy
from torchrl_nerd.evaluation.policy_transfer import transfer, transfer_table
from torchrl_nerd.robots import make_task
from torchrl_nerd.settings import expect_at_least


@dataclass(frozen=True)
class Transfer(MeasuringCommand):
    """Returns of a policy in several dynamics, and their difference to the ground truth.

    Example: nerd transfer ant/run --episodes 256

    Example: nerd transfer cartpole/swingup --policy runs/ppo
    """

    task: Positional[str]
    """Id of the task, such as cartpole/swingup, dm_control/DOMAIN-TASK or gymnasium/ID."""
    policy: Path | None = None
    """Folder of a policy, as examples/ppo.py writes it; by default the shipped one."""
    dynamics: Annotated[tuple[str, ...], tyro.conf.arg(aliases=("--model",))] = (
        "nerd",
        "mujoco",
    )
    """Any of nerd, hybrid, analytic, mujoco, dm_control, mujoco_warp, names of shipped
    models, checkpoint folders."""
    episodes: int = 2048
    """How many episodes of each dynamics the returns are means of."""
    seed: int = 500
    """Seed of the resets."""

    def inputs(self) -> Actor:
        """The policy; dynamics that the task does not have are refused."""
        expect_at_least(2, episodes=self.episodes)
        task, folder = make_task(self.task), self.policy or shipped_policy(self.task)
        for name in self.dynamics:
            make_env(task, name)
        return make_actor(load_policy(folder, task).to(self.device))

    def run(self) -> dict[str, Any]:
        """Print a table and return its rows; bad input raises ValueError."""
        actor = self.inputs()
        about = self.task, actor, self.dynamics, self.episodes
        summaries = transfer(
            *about, seed=self.seed, device=self.device, quiet=self.quiet
        )
        print(transfer_table(summaries))
        rows = [{"dynamics": name, **asdict(s)} for name, s in summaries.items()]
        used = str(self.policy or "shipped")
        return {"task": self.task, "policy": used, "returns": rows}
