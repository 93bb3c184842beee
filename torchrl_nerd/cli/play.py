"""``nerd play``: a video of one rollout in learned dynamics beside MuJoCo."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from torchrl_nerd.cli.command import DeviceCommand
from torchrl_nerd.cli.options import Positional
from torchrl_nerd.envs import make_env
from torchrl_nerd.envs.actor import Actor
from torchrl_nerd.envs.rendering import require_gl
from torchrl_nerd.evaluation.policy import load_policy, make_actor, shipped_policies
from torchrl_nerd.evaluation.side_by_side import (
    FixedActions,
    SideBySide,
    check_video,
    write_video,
)
from torchrl_nerd.files import folder_name
from torchrl_nerd.robots import make_task
from torchrl_nerd.settings import expect_at_least

SECONDS = 5.0  # of simulated time, unless --steps or the task's horizon says less


@dataclass(frozen=True)
class Play(DeviceCommand):
    """A video of one rollout in the chosen dynamics beside MuJoCo, from the same start.

    Example: nerd play ant/run --dynamics ant-mlp --out ant.gif

    Example: nerd play cartpole/swingup --policy runs/ppo --out swing_up.mp4

    Example: nerd play robot.xml --dynamics runs/robot/best
    """

    task: Positional[str]
    """Id of the task, such as cartpole/swingup, dm_control/DOMAIN-TASK or gymnasium/ID; or
    an MJCF file, which has no reward and acts at random."""
    dynamics: Annotated[str, tyro.conf.arg(aliases=("--model",))] = "nerd"
    """What steps the robot on the left: nerd, hybrid, analytic, a shipped model or a
    checkpoint folder."""
    policy: Path | None = None
    """Folder of a policy, as examples/ppo.py writes it; the shipped one by default."""
    actions: FixedActions | None = None
    """Random or zero actions instead of a policy; random if no policy is shipped."""
    open_loop: bool = False
    """Repeat the actions of MuJoCo's rollout in the chosen dynamics. By default the policy
    acts on the observation of each."""
    seed: int = 0
    """Of the start and of random actions."""
    steps: int | None = None
    """How many actions the video shows; by default 5 s of them, or an episode."""
    out: Path | None = None
    """Video, .gif or .mp4; runs/TASK.gif by default."""
    width: int = 720
    """Width of the video in pixels."""
    slowdown: float = 1.0
    """2 plays at half speed."""

    @property
    def video(self) -> Path:
        """Where it goes."""
        return self.out or Path("runs") / f"{folder_name(self.task)}.gif"

    @property
    def record(self) -> Path:
        """Where results and settings go: ``json``, or beside the video."""
        return self.json or self.video.with_name(f"{self.video.name}.json")

    def inputs(self) -> tuple[Actor | FixedActions, int]:
        """What acts, and for how many steps; refuse bad input."""
        task = make_task(self.task)
        check_video(self.video)
        if not 0.0 < self.slowdown < float("inf"):
            raise ValueError(f"expected slowdown above 0, got {self.slowdown}")
        expect_at_least(64, width=self.width)
        make_env(self.task, self.dynamics)
        shown = min(task.horizon, round(SECONDS / task.step_size))
        steps = shown if self.steps is None else self.steps
        expect_at_least(1, steps=steps)
        if self.policy is not None and self.actions is not None:
            raise ValueError("expected --policy or --actions, got both")
        folder = self.policy or shipped_policies().get(self.task)
        if self.actions is not None or folder is None:
            return self.actions or "random", steps
        return make_actor(load_policy(folder, task).to(self.device)), steps

    def run(self) -> dict[str, Any]:
        """Roll out, write the video and return what happened; refuse bad input."""
        (actor, steps), out = self.inputs(), self.video
        require_gl()
        both, closed_loop = (self.dynamics, "mujoco"), not self.open_loop
        pair = SideBySide(self.task, both, actor, self.seed, closed_loop, self.device)
        frames = write_video(pair, out, steps, self.width, self.slowdown, self.quiet)
        print(f"{out}: {pair.seconds:.2f} s, {frames} frames")
        rollouts = []
        for name, kind, total in zip(pair.names, pair.kinds, pair.returns, strict=True):
            rollouts.append({"dynamics": name, "kind": kind, "return": total})
            print(f"{name:<20} {kind:<14}{total:.1f} return")
        length = {"steps": pair.steps, "seconds": pair.seconds}
        found = {"ending": pair.ending or "steps", "rollouts": rollouts}
        return {"task": self.task, "video": out, **length, **found}
