"""``nerd bench``: speed against error, the shipped models and MuJoCo in one race."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchrl_nerd.cli.command import DeviceCommand
from torchrl_nerd.cli.options import Positional
from torchrl_nerd.evaluation.bench.plot import plot_race
from torchrl_nerd.evaluation.bench.report import bench
from torchrl_nerd.evaluation.bench.table import bench_table
from torchrl_nerd.robots import load_scene


@dataclass(frozen=True)
class Bench(DeviceCommand):
    """Speed against error: the shipped models and MuJoCo, coarse and fine, in one race.

    Example: nerd bench cartpole --json results/bench.json --plot results/bench.png

    Example: nerd bench dm_control/cheetah-run --models runs/dm_control-cheetah-run/best
    """

    scene: Positional[str]
    """Name of the robot: cartpole, double_pendulum, ant, ..., dm_control/DOMAIN-TASK."""
    models: tuple[str, ...] = ()
    """Names of models, or checkpoint folders; all that are shipped for it by default."""
    batches: tuple[int, ...] = (1, 64, 512, 4096)
    """Rows stepped together."""
    rows: int = 256
    """Trajectories per case, for the errors."""
    rounds: int = 5
    """Turns of each contender."""
    seed: int = 500
    """Of the starts."""
    steps: int | None = None
    """Horizon of the errors; the paper's by default."""
    compile: bool = True
    """Have compiled rows."""
    threads: int | None = None
    """Processor threads; torch's own choice by default."""
    budget: tuple[float, ...] = ()
    """Largest mean errors, in the table's order: names the fastest row within them."""
    without: tuple[str, ...] = ()
    """Rows with one of these in their names take no part, as in --without mlp bf16."""
    plot: Path | None = None
    """Draw the race to this PNG."""
    quiet: bool = False
    """No progress bars."""

    @property
    def figure(self) -> Path | None:
        """The drawing, where it was asked for."""
        return self.plot

    def run(self) -> dict[str, Any]:
        """Print the tables and return their figures."""
        report = bench(
            load_scene(self.scene),
            self.batches,
            self.rows,
            self.rounds,
            self.seed,
            self.steps,
            self.compile,
            self.threads,
            self.device,
            self.quiet,
            self.without,
            self.models,
        )
        print(bench_table(report))
        for batch in self.batches if self.budget else ():
            choice = report.choice(batch, self.budget) or "none"
            print(f"fastest within {self.budget}, {batch} rows: {choice}")
        if self.plot is not None:
            plot_race(report, self.plot)
        return report.figures()
