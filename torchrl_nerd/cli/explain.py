"""``nerd explain``: what of a scene a model sees, what is left out, and why."""

from dataclasses import asdict, dataclass
from typing import Any

from torchrl_nerd.cli.command import Command
from torchrl_nerd.cli.options import Positional, SceneName
from torchrl_nerd.evaluation.explain import explain
from torchrl_nerd.robots import load_scene
from torchrl_nerd.scenes import Scene
from torchrl_nerd.training.symmetry import Symmetry


@dataclass(frozen=True)
class Explain(Command):
    """What of a scene a model sees, what is left out, and why.

    Example: nerd explain double_pendulum --json results/explain.json
    """

    scene: Positional[SceneName]

    def inputs(self) -> Scene:
        """The robot and its surroundings."""
        return load_scene(self.scene)

    def run(self) -> dict[str, Any]:
        """Print the report and return its contents."""
        scene = self.inputs()
        report = explain(scene)
        counts, why_none = _symmetries(scene)
        why = why_none or f"nerd train {self.scene} --symmetries {counts[-1]}"
        listed = f"{', '.join(map(str, counts))}: {why}"
        print(report, f"symmetries of a network: {listed}", sep="\n")
        found = {"symmetries": counts, "why_no_symmetries": why_none}
        return asdict(report) | {"token_width": report.token_width} | found


def _symmetries(scene: Scene) -> tuple[list[int], str | None]:
    """Numbers of symmetries that a network can have, or why it is 1 alone."""
    try:
        counts = Symmetry(scene).counts()
    except ValueError as error:
        return [1], str(error)
    none = "no mirror or half turn commutes with MuJoCo's step and the features"
    return counts, none if counts == [1] else None
