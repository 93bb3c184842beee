"""A hard case: physics whose outcome is known, and a line that every dynamics must keep."""

from collections.abc import Callable
from dataclasses import dataclass, field

from torch import Generator

from torchrl_nerd.evaluation.stability.world import World
from torchrl_nerd.scenes import Scene

Figures = dict[str, float]
"""What a case measured, by name with its unit."""


@dataclass(frozen=True)
class Case:
    """One hard case.

    | field | meaning |
    |---|---|
    | ``name`` | of its file |
    | ``physics`` | what should happen, and why, in a sentence |
    | ``run`` | measures one world; ``scale`` in (0, 1] shortens long rollouts |
    | ``applies`` | whether it makes sense for a robot |
    | ``needs_dynamics`` | whether an env, which shows states alone, does not do |
    | ``true_lines``, ``lines`` | largest allowed figure in true and learned dynamics |

    A figure without a line is for information. The line of the true dynamics validates
    the case itself.
    """

    name: str
    physics: str
    run: Callable[[World, Generator, float], Figures]
    applies: Callable[[Scene], bool] = lambda scene: True
    true_lines: Figures = field(default_factory=dict)
    lines: Figures = field(default_factory=dict)
    needs_dynamics: bool = False

    def passes(self, figures: Figures, is_true: bool) -> bool:
        """Whether every figure that has a line keeps it; one that is no number does not."""
        lines = self.true_lines if is_true else self.lines
        return all(figures[name] <= line for name, line in lines.items())


def has_floating_base(scene: Scene) -> bool:
    """Whether the base moves freely."""
    return scene.base.is_floating


def has_motors(scene: Scene) -> bool:
    """Whether there is a torque to drive with."""
    return bool(len(scene.actuated))
