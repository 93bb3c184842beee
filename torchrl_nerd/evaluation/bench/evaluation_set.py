"""Initial states, actions and the ground truth's trajectories: equal for all candidates."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from tensordict import TensorDict
from torch import Generator, Tensor

from torchrl_nerd.dynamics.base import Dynamics
from torchrl_nerd.evaluation.rollout_error import (
    Drive,
    action_drive,
    initial_states,
    open_loop,
    position_errors,
    scene_of,
)
from torchrl_nerd.geometry.manifold import integrate_pos
from torchrl_nerd.keys import QPOS
from torchrl_nerd.robots import EvaluationProtocol, Source
from torchrl_nerd.scenes import Scene

DRIVEN = "driven"
"""The case of uniform random actions, beside the passive ones."""


@dataclass(frozen=True)
class EvaluationSet:
    """One case: what every candidate starts from, is driven by and is measured against.

    | field | meaning |
    |---|---|
    | ``case`` | its name |
    | ``source`` | whose initial states and controller |
    | ``start`` | initial states, ``[n]`` |
    | ``drive`` | joint torques |
    | ``ground_truth`` | positions after each step, ``(n, steps, nq)`` |
    """

    case: str
    source: Source
    start: TensorDict
    drive: Drive
    ground_truth: Tensor

    @property
    def scene(self) -> Scene:
        """The robot and its terrain."""
        return scene_of(self.source)

    def errors(
        self, dynamics: Dynamics, start: TensorDict | None = None
    ) -> dict[str, Tensor]:
        """Error of every quantity at every step, ``(n, steps)``; NaN where it diverges.

        Args:
            dynamics: of the same robot and terrain.
            start: other initial states ``[n]`` than the set's.
        """
        start = self.start if start is None else start
        steps = self.ground_truth.shape[1]
        path = open_loop(dynamics, start, steps, self.drive, stop_at_nan=True)
        return position_errors(self.scene, self.ground_truth, path)

    @property
    def zeros(self) -> dict[str, Tensor]:
        """The errors of the ground truth itself, by definition."""
        both = self.ground_truth, self.ground_truth
        return {k: 0.0 * e for k, e in position_errors(self.scene, *both).items()}

    def perturbed(self, size: float, seed: int) -> TensorDict:
        """The initial states with ``size`` (m, rad) times a normal number added to each."""
        layout, start = self.scene.layout, self.start.clone()
        shape, generator = (len(start), layout.nv), Generator().manual_seed(seed)
        noise = torch.randn(shape, dtype=torch.float64, generator=generator)  # (n, nv)
        start[QPOS] = integrate_pos(layout, start[QPOS], size * noise.to(start[QPOS]))
        return start


def cases_of(protocol: EvaluationProtocol) -> Iterator[tuple[str, Source, bool]]:
    """Name, source and whether actions are random, of every case of a protocol.

    A robot with actuators gets a driven case after its own, unless it has one.
    """
    for case, source in protocol.cases.items():
        yield case, source, case in protocol.random_actions
    last = list(protocol.cases.values())[-1]
    if scene_of(last).actuated and not protocol.random_actions:
        yield DRIVEN, last, True


def evaluation_set(
    case: str,
    source: Source,
    is_driven: bool,
    ground_truth: Callable[[Scene], Dynamics],
    num_trajectories: int,
    steps: int,
    seed: int,
    device: torch.device | str = "cpu",
) -> EvaluationSet:
    """The set of one case, of which the ground truth makes the trajectories."""
    start = initial_states(source, num_trajectories, seed).to(device)
    drive = action_drive(source, num_trajectories, steps, seed, is_driven)
    path = open_loop(ground_truth(scene_of(source)), start, steps, drive)
    return EvaluationSet(case, source, start, drive, path)
