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
        found, how = _symmetries(scene)
        print(report, f"symmetries of a network: {how}", sep="\n")
        return asdict(report) | {"token_width": report.token_width} | found


def _symmetries(scene: Scene) -> tuple[dict[str, Any], str]:
    """Numbers of symmetries that a network can have, and in words, or why it is 1 alone."""
    counts, near, why = [1], [1], None
    try:
        found = Symmetry.most(scene)
        if found.is_near:
            near = found.counts()
        else:
            counts = found.counts()
        if counts == [1]:
            why = "no mirror or half turn commutes with MuJoCo's step and the features"
    except ValueError as error:
        why = str(error)
    how = f"{', '.join(map(str, counts))}: "
    if len(near) > 1:
        how += f"nearly {near[-1]}: --symmetries {near[-1]} --near-symmetry"
    else:
        how += why or f"nerd train {scene.name} --symmetries {counts[-1]}"
    numbers = {"symmetries": counts, "near_symmetries": near}
    return numbers | {"why_no_symmetries": why}, how
