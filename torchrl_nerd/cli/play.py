"""``nerd play``: a video of one rollout in learned dynamics beside MuJoCo."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchrl_nerd.cli.command import DeviceCommand
from torchrl_nerd.cli.options import Positional
from torchrl_nerd.evaluation.policy import load_policy, make_actor, shipped_policies
from torchrl_nerd.evaluation.render.renderer import require_gl
from torchrl_nerd.evaluation.render.side_by_side import FixedActions, roll_out_both
from torchrl_nerd.evaluation.render.video import check_video, write_video
from torchrl_nerd.files import folder_name
from torchrl_nerd.robots import make_task
from torchrl_nerd.settings import expect_at_least

SECONDS = 5.0  # of simulated time, unless --steps or the task's horizon says less


@dataclass(frozen=True)
class Play(DeviceCommand):
    """A video of one rollout in the chosen dynamics beside MuJoCo, from the same start.

    Example: nerd play ant/run --dynamics ant-mlp --out ant.gif

    Example: nerd play cartpole/swingup --policy runs/ppo --out swing_up.mp4
    """

    task: Positional[str]
    """Id of the task, such as cartpole/swingup."""
    dynamics: str = "nerd"
    """Of the left robot: nerd, hybrid, analytic, a shipped model or a checkpoint folder."""
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
    """Of the env; 5 s or the task's horizon by default."""
    out: Path | None = None
    """Video, .gif or .mp4, or .png for a figure of six frames; runs/TASK.gif by default."""
    width: int = 720
    """Of the video, pixels."""
    slowdown: float = 1.0
    """2 plays at half speed."""
    quiet: bool = False
    """No progress bar."""

    @property
    def figure(self) -> Path:
        """The video."""
        return self.out or Path("runs") / f"{folder_name(self.task)}.gif"

    def run(self) -> dict[str, Any]:
        """Roll out, write the video and return what happened.

        Raises:
            ValueError: in one sentence, an option out of range or no such task or model.
        """
        task, out = make_task(self.task), self.figure
        check_video(out)
        if not 0.0 < self.slowdown < float("inf"):
            raise ValueError(f"expected slowdown above 0, got {self.slowdown}")
        expect_at_least(64, width=self.width)
        step_size = task.scene.control_step * task.frame_skip
        steps = min(task.horizon, round(SECONDS / step_size))
        if self.steps is not None:
            expect_at_least(1, steps=self.steps)
            steps = self.steps
        folder, actor = self.policy, self.actions or "random"
        if folder is None and self.actions is None:
            folder = shipped_policies().get(self.task)
        if folder is not None:
            actor = make_actor(load_policy(folder, task).to(self.device))
        require_gl()
        both, closed_loop = (self.dynamics, "mujoco"), not self.open_loop
        how = (steps, self.seed, closed_loop, self.device)
        pair = roll_out_both(self.task, both, actor, *how)
        frames = write_video(pair, out, self.width, self.slowdown, self.quiet)
        print(f"{out}: {pair.seconds:.2f} s, {frames} frames")
        rollouts = []
        for i in range(2):
            one = {"dynamics": pair.names[i], "kind": pair.kinds[i]}
            rollouts.append({**one, "return": float(pair.returns[i][-1])})
            print(
                f"{pair.names[i]:<20}{pair.kinds[i]:<14}{pair.returns[i][-1]:.1f} return"
            )
        return {
            "task": self.task,
            "video": out,
            "steps": len(pair.paths[0]) - 1,
            "seconds": pair.seconds,
            "ending": pair.ending,
            "rollouts": rollouts,
        }
