"""``nerd bench``: speed and error of MuJoCo and of every model of a scene."""

from dataclasses import asdict, dataclass
from typing import Any

from torchrl_nerd.cli.command import MeasuringCommand
from torchrl_nerd.cli.options import Positional, SceneName
from torchrl_nerd.evaluation.bench.report import bench, bench_table
from torchrl_nerd.robots import load_scene


@dataclass(frozen=True)
class Bench(MeasuringCommand):
    """Speed and error of MuJoCo, at many settings, and of every model of a scene.

    Errors are against MuJoCo with a solver so fine that its own error no longer counts.

    Example: nerd bench cartpole --json results/bench_cartpole.json

    Example: nerd bench dm_control/cheetah-run --models runs/dm_control-cheetah-run/best
    """

    scene: Positional[SceneName]
    models: tuple[str, ...] = ()
    """As --model of other commands, several of them; all that are shipped by default."""
    variants: tuple[str, ...] = ("compiled",)
    """Other ways to run each model, see nerd eval: compiled, window, bf16."""
    batches: tuple[int, ...] = (1, 64, 512, 4096)
    """How many trajectories are stepped together, for the rates."""
    num_trajectories: int = 256
    """How many trajectories of each case the errors are means of."""
    rounds: int = 5
    """Samples of each candidate's speed; the median is shown."""
    seed: int = 500
    """Of the initial states."""
    steps: int | None = None
    """Horizon of the errors; the paper's by default."""

    def run(self) -> dict[str, Any]:
        """Print the tables and return their numbers."""
        report = bench(
            load_scene(self.scene),
            self.batches,
            self.num_trajectories,
            self.rounds,
            self.seed,
            self.steps,
            self.variants,
            self.device,
            self.quiet,
            self.models,
        )
        print(bench_table(report))
        return asdict(report)
