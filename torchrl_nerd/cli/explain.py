"""``nerd explain``: which features a scene has, why, and the proof."""

from dataclasses import asdict, dataclass
from typing import Any

from torchrl_nerd.cli.command import Command
from torchrl_nerd.cli.options import Positional
from torchrl_nerd.evaluation.explain.report import explain
from torchrl_nerd.evaluation.explain.table import report_table
from torchrl_nerd.robots import load_scene


@dataclass(frozen=True)
class Explain(Command):
    """What a network sees of a scene, what is left out, and proofs that it may be.

    Example: nerd explain double_pendulum --json results/explain.json
    """

    scene: Positional[str]
    """Name of the robot: cartpole, double_pendulum, dm_control/DOMAIN-TASK, gymnasium/ID,
    or an MJCF file."""
    rows: int = 1024
    """Random states to ask the true solver about, and rows of the timing."""
    seed: int = 0
    """Of these states."""
    network: str = "transformer-2x64"
    """What to time the compact input and the paper's with."""
    timing: bool = True
    """Time them."""

    def run(self) -> dict[str, Any]:
        """Print the report and return its figures."""
        scene = load_scene(self.scene)
        network = self.network if self.timing else None
        report = explain(scene, self.rows, self.seed, network)
        print(report_table(report))
        return asdict(report) | {"unused": report.unused, "derived": report.derived}
