"""``nerd stability``: hard cases in true and in learned dynamics."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

from torchrl_nerd.checkpoint import from_pretrained
from torchrl_nerd.cli.command import DeviceCommand
from torchrl_nerd.cli.options import Positional
from torchrl_nerd.dynamics import MujocoDynamics, dynamics_of
from torchrl_nerd.evaluation.stability.plot import plot_results
from torchrl_nerd.evaluation.stability.run import (
    as_json,
    as_table,
    choose_cases,
    run_cases,
)
from torchrl_nerd.evaluation.stability.world import DynamicsWorld
from torchrl_nerd.robots import load_scene
from torchrl_nerd.settings import SettingError


@dataclass(frozen=True)
class Stability(DeviceCommand):
    """Hard cases: conservation, contact, geometry, bad input, long runs, gradients.

    A case whose line is not met stays in the table; the exit status is 0 all the same.

    Example: nerd stability cartpole --json results/stability.json --plot stability.png
    """

    scene: Positional[str]
    """Name of the robot: cartpole, double_pendulum, ant, franka, anymal, cube, ..."""
    cases: tuple[str, ...] = ()
    """Only these; all that apply by default."""
    model: str | None = None
    """Checkpoint folder; the shipped model by default."""
    seed: int = 0
    """Of starts and torques."""
    scale: float = 1.0
    """Share of the long rollouts' steps and of large batches' rows, in (0, 1]."""
    compile: bool = False
    """Compile the model's step: long cases take a fraction of the time."""
    plot: Path | None = None
    """Draw every figure as a share of its line to this PNG."""
    quiet: bool = False
    """No progress bar."""

    @property
    def figure(self) -> Path | None:
        """The drawing, where it was asked for."""
        return self.plot

    def run(self) -> dict[str, Any]:
        """Print a line per case, then the table, and return the figures.

        Raises:
            ValueError: no such robot, case or model, or a scale out of range.
        """
        if not 0.0 < self.scale <= 1.0:
            raise SettingError(f"expected a scale in (0, 1], got {self.scale}")
        cases = choose_cases(list(self.cases) or None)
        scene = load_scene(self.scene)
        model = from_pretrained(self.model or self.scene, scene).to(self.device)
        truth = DynamicsWorld(MujocoDynamics(scene))
        learned = DynamicsWorld(dynamics_of(model, compile=self.compile))
        results, count = [], sum(case.applies(scene) for case in cases)
        figures: dict[str, Any] = {"scene": self.scene, "seed": self.seed}
        figures["scale"] = self.scale
        found = run_cases(truth, learned, cases, self.seed, self.scale)
        for result in tqdm(found, "cases", count, leave=False, disable=self.quiet):
            verdict = "met" if result.passes else "NOT MET"
            tqdm.write(f"{result.case:<18}{verdict:<9}{result.seconds:>7} s")
            results.append(result)
            figures |= as_json([result])
            self.keep(figures)  # hours of long cases outlive an interruption
        print()
        print(as_table(results))
        if self.plot is not None:
            plot_results(results, self.plot, f"{self.scene}: learned dynamics")
        return figures
