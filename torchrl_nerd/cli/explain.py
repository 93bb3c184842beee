"""``nerd explain``: what of a scene a model sees, what is left out, and why."""

from dataclasses import asdict, dataclass
from typing import Any

from torchrl_nerd.cli.command import Command
from torchrl_nerd.cli.options import Positional, SceneName
from torchrl_nerd.evaluation.explain import explain
from torchrl_nerd.robots import load_scene


@dataclass(frozen=True)
class Explain(Command):
    """What of a scene a model sees, what is left out, and why.

    Example: nerd explain double_pendulum --json results/explain.json
    """

    scene: Positional[SceneName]

    def run(self) -> dict[str, Any]:
        """Print the report and return its contents."""
        report = explain(load_scene(self.scene))
        print(report)
        return asdict(report) | {"token_width": report.token_width}
