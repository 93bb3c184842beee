"""``nerd bench``: speed and error of MuJoCo and of every model of a scene."""

from dataclasses import asdict, dataclass
from typing import Any

from torchrl_nerd.cli.command import MeasuringCommand
from torchrl_nerd.cli.options import Positional, SceneName
from torchrl_nerd.evaluation.bench.candidates import models
from torchrl_nerd.evaluation.bench.report import BenchConfig, bench, bench_table
from torchrl_nerd.robots import load_scene
from torchrl_nerd.scenes import Scene


@dataclass(frozen=True)
class Bench(BenchConfig, MeasuringCommand):
    """Speed and error of MuJoCo, at many settings, and of every model of a scene.

    Errors are against MuJoCo with a solver so fine that its own error no longer counts.

    Example: nerd bench cartpole --json results/bench_cartpole.json

    Example: nerd bench dm_control/cheetah-run --models runs/dm_control-cheetah-run/best
    """

    scene: Positional[SceneName]

    def inputs(self) -> Scene:
        """The robot and its surroundings."""
        self.check()
        return load_scene(self.scene)

    def plan(self) -> list[str]:
        """Nothing to say; models that are none are refused, as `bench` does at once."""
        models(self.inputs(), self.models)
        return []

    def run(self) -> dict[str, Any]:
        """Print the tables and return their numbers."""
        report = bench(self.inputs(), self, self.device, self.quiet)
        print(bench_table(report))
        return asdict(report)
