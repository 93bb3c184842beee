"""How far each contender's rollouts are from the finest truth, and the chaos floor."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from tensordict import TensorDict
from torch import Generator, Tensor

from torchrl_nerd.dynamics.base import Dynamics
from torchrl_nerd.evaluation.bench.contenders import Contender, truth
from torchrl_nerd.evaluation.rollout_error import (
    Drive,
    ErrorSummary,
    action_drive,
    initial_states,
    open_loop,
    position_errors,
    scene_of,
    summarize,
)
from torchrl_nerd.geometry.manifold import integrate_pos
from torchrl_nerd.keys import QPOS
from torchrl_nerd.robots import EvaluationProtocol, Source
from torchrl_nerd.scenes import Scene

Errors = dict[str, ErrorSummary]
PERTURBATIONS = (1e-6, 1e-4, 1e-2)  # m and rad, of every coordinate at the start


@dataclass(frozen=True)
class Course:
    """Starts, actions and what the truth makes of them, in one case of a protocol."""

    source: Source
    start: TensorDict
    drive: Drive
    steps: int
    path: Tensor  # (rows, steps, nq)

    @classmethod
    def of(
        cls,
        source: Source,
        rows: int,
        steps: int,
        seed: int,
        random: bool,
        threads: int,
    ) -> "Course":
        """Step the truth."""
        start = initial_states(source, rows, seed)
        drive = action_drive(source, rows, steps, seed, random)
        path = open_loop(truth(scene_of(source), threads), start, steps, drive)
        return cls(source, start, drive, steps, path)

    @property
    def scene(self) -> Scene:
        """The robot and its ground."""
        return scene_of(self.source)

    def errors(self, dynamics: Dynamics, start: TensorDict | None = None) -> Mapping:
        """Error of every quantity at every step, ``(rows, steps)``."""
        start = self.start if start is None else start
        path = open_loop(dynamics, start, self.steps, self.drive)
        return position_errors(self.scene, self.path, path)

    def perturbed(self, size: float, seed: int) -> TensorDict:
        """The starts, every coordinate moved by ``size`` (m, rad) times a normal number."""
        layout, start = self.scene.layout, self.start.clone()
        shape, generator = (len(start), layout.nv), Generator().manual_seed(seed)
        noise = torch.randn(shape, dtype=torch.float64, generator=generator)
        start[QPOS] = integrate_pos(layout, start[QPOS], size * noise)
        return start


def courses(
    protocol: EvaluationProtocol,
    rows: int,
    seed: int,
    threads: int,
    steps: int | None = None,
) -> list[Course]:
    """One course for each case of a protocol, over its longest published horizon."""
    published = {horizon for _, horizon, _ in protocol.published}
    steps = steps or max(published or protocol.horizons)
    return [
        Course.of(source, rows, steps, seed, case in protocol.random_actions, threads)
        for case, source in protocol.cases.items()
    ]


def contender_errors(contender: Contender, courses: list[Course]) -> Errors:
    """Summary over all rows of all courses."""
    parts = [course.errors(contender.make(course.scene)) for course in courses]
    return _merge(courses, parts)


def chaos_floor(courses: list[Course], threads: int, seed: int) -> dict[str, Errors]:
    """What the truth itself makes of starts that are a little off."""
    floors = {}
    for size in PERTURBATIONS:
        parts = [
            course.errors(truth(course.scene, threads), course.perturbed(size, seed))
            for course in courses
        ]
        floors[f"truth, starts off by {size:.0e}"] = _merge(courses, parts)
    return floors


def _merge(courses: list[Course], parts: list[Mapping]) -> Errors:
    merged = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
    return summarize(courses[0].scene, merged)
