"""``nerd play``: learned and true motion side by side."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchrl_nerd.cli.command import DeviceCommand
from torchrl_nerd.cli.options import Positional
from torchrl_nerd.evaluation.policy import load_policy, make_actor
from torchrl_nerd.evaluation.render.film import Draw, film
from torchrl_nerd.evaluation.render.movie import check_movie
from torchrl_nerd.evaluation.render.pair import Idle, Pair, follow, idle, play_pair
from torchrl_nerd.evaluation.render.viewer import check_display, view
from torchrl_nerd.evaluation.rollout_error import unit_of
from torchrl_nerd.evaluation.shipped_policies import shipped_policies
from torchrl_nerd.files import folder_name
from torchrl_nerd.robots import make_task
from torchrl_nerd.settings import expect_at_least

SECONDS = 5.0  # of motion, where neither steps nor the task says less


@dataclass(frozen=True)
class Play(DeviceCommand):
    """A film of one episode, learned beside MuJoCo: same start, same actions.

    Example: nerd play ant/run --seed 3 --steps 120

    Example: nerd play cartpole/swingup --policy runs/ppo --out swing_up.gif
    """

    task: Positional[str]
    """Id of the task, such as cartpole/swingup."""
    policy: Path | None = None
    """Folder of a policy, as examples/ppo.py writes it; by default the shipped one."""
    actions: Idle | None = None
    """Random or zero, in place of a policy; random where a task has none."""
    own_actions: bool = False
    """The policy acts on each dynamics' own state, not on MuJoCo's for both."""
    model: str = "nerd"
    """Checkpoint folder; the shipped model by default."""
    seed: int = 0
    """Of the start and of random actions."""
    steps: int | None = None
    """Of the env; 5 s or the task's horizon by default."""
    out: Path | None = None
    """Film to write, .gif or .mp4; runs/TASK.gif by default."""
    slow: float = 1.0
    """Times slower than life."""
    draw: Draw = "auto"
    """OpenGL where it works without a screen, else drawings; or one of them."""
    viewer: bool = False
    """Show it in MuJoCo's window in place of a film."""
    quiet: bool = False
    """No progress bar."""

    @property
    def picture(self) -> Path | None:
        """The film."""
        if self.viewer:
            return None
        return self.out or Path("runs") / f"{folder_name(self.task)}.gif"

    def run(self) -> dict[str, Any]:
        """Play, film or show, and return the errors."""
        task = make_task(self.task)
        out = self.picture
        check_display() if out is None else check_movie(out)
        if self.slow <= 0.0:
            raise ValueError(f"expected slow above 0, got {self.slow}")
        size = task.scene.control_step * task.frame_skip
        steps = min(task.horizon, round(SECONDS / size))
        if self.steps is not None:
            expect_at_least(1, steps=self.steps)
            steps = self.steps
        frame_stack, folder = 1, self.policy
        if folder is None and self.actions is None:
            folder = shipped_policies().get(self.task)
        if folder is None:
            act = idle(task, steps, self.seed, self.actions or "random")
        else:
            policy = load_policy(folder, task).to(self.device)
            act, frame_stack = follow(make_actor(policy)), policy.frame_stack
        pair = play_pair(
            self.task,
            self.model,
            act,
            steps,
            self.seed,
            self.own_actions,
            self.device,
            frame_stack,
        )
        drawn = None
        if out is None:
            view(pair, self.slow)
        else:
            drawn = film(pair, out, self.task, self.slow, self.draw, self.quiet)
            print(f"{out}: {pair.seconds:.2f} s, drawn by {drawn}")
        figures = pair_figures(pair)
        for name, error in figures["errors"].items():
            print(
                f"{name:<18}{error['mean']:>10.5f} mean{error['final']:>10.5f} final "
                f"{error['unit']}"
            )
        shared = {"task": self.task, "seed": self.seed, "renderer": drawn}
        return {**shared, "film": out, **figures}


def pair_figures(pair: Pair) -> dict[str, Any]:
    """Errors and returns of a pair, for JSON."""
    errors = {
        name: {
            "unit": unit_of(pair.scene, name),
            "mean": float(values[1:].mean()),
            "final": float(values[-1]),
        }
        for name, values in pair.errors.items()
    }
    return {
        "steps": len(pair.truth) - 1,
        "seconds": pair.seconds,
        "ending": pair.ending,
        "returns": dict(zip(("learned", "mujoco"), pair.returns, strict=True)),
        "errors": errors,
    }
