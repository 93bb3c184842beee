"""A hard case: physics with a known outcome, and tolerances for what is measured."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from tensordict import TensorDict
from torch import Generator, Tensor

from torchrl_nerd.dynamics import Dynamics, MujocoDynamics, NeRDDynamics
from torchrl_nerd.evaluation.rollout_error import position_errors, rollout
from torchrl_nerd.evaluation.stability import states
from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.sampling import sample_torque

Metrics = dict[str, float]
"""What a case measured, by name with its unit."""


@dataclass(frozen=True)
class Trial:
    """One run of a case: what is stepped, and the random numbers.

    | field | meaning |
    |---|---|
    | ``dynamics`` | under test |
    | ``generator`` | of starts and torques |
    | ``scale`` | fraction of long rollouts and large batches, in (0, 1] |
    """

    dynamics: Dynamics
    generator: Generator
    scale: float = 1.0

    @property
    def scene(self) -> Scene:
        """The robot."""
        return self.dynamics.scene

    @property
    def model(self) -> NeRD:
        """The model, for cases that need one."""
        assert isinstance(self.dynamics, NeRDDynamics)
        return self.dynamics.model

    def roll(self, start: TensorDict, steps: int, *how: Any, **more: Any) -> TensorDict:
        """`rollout` in the dynamics under test."""
        return rollout(self.dynamics, start, steps, *how, **more)

    def roll_exactly(self, start: TensorDict, steps: int, *how: Any) -> TensorDict:
        """`rollout` in MuJoCo."""
        return rollout(MujocoDynamics(self.scene), start, steps, *how)

    def scaled(self, count: int, least: int) -> int:
        """A number of steps or trajectories times the scale."""
        return max(least, round(self.scale * count))

    def starts(self, count: int) -> TensorDict:
        """States ``[count]`` from the scene's training range."""
        return states.sample_states(self.scene, count, self.generator)

    def settled(self, count: int) -> TensorDict:
        """Up to ``count`` states at rest, see `settled_states`."""
        return states.settled_states(self.scene, count).clone()

    def in_air(self, count: int, speed: float) -> TensorDict:
        """States ``[count]`` that nothing touches, at a fraction of the training speeds."""
        start = states.clear_of_ground(self.scene, self.starts(count))
        return start.set(QVEL, speed * start[QVEL])

    def torques(self, count: int, steps: int) -> Tensor:
        """Torques in the training range, ``(count, steps, num_actuated)``."""
        scale = torch.ones(count, 1, dtype=torch.float64)
        return sample_torque(self.scene.sampling, scale, steps, self.generator)

    def normal(self, *shape: int) -> Tensor:
        """Standard normal numbers, float64."""
        return torch.randn(shape, generator=self.generator, dtype=torch.float64)

    def difference(self, path: TensorDict, other: TensorDict) -> Tensor:
        """Largest difference of all position quantities, m or rad, ``(n, steps)``."""
        errors = position_errors(self.scene, path[QPOS], other[QPOS])
        return torch.stack(list(errors.values())).amax(0)  # over quantities


@dataclass(frozen=True)
class Case:
    """One hard case.

    | field | meaning |
    |---|---|
    | ``name`` | of the case |
    | ``physics`` | what should happen, and why, in a sentence |
    | ``run`` | measures one trial |
    | ``applies`` | whether it makes sense for a robot |
    | ``tolerances`` | largest allowed metrics of the tested dynamics |
    | ``ground_truth_tolerances`` | of MuJoCo: they validate the case itself |
    | ``needs_model`` | whether it asks for a model with a network |

    A metric without a tolerance is for information.
    """

    name: str
    physics: str
    run: Callable[[Trial], Metrics]
    applies: Callable[[Scene], bool] = lambda scene: True
    tolerances: Metrics = field(default_factory=dict)
    ground_truth_tolerances: Metrics = field(default_factory=dict)
    needs_model: bool = False

    def passes(self, metrics: Metrics, is_ground_truth: bool) -> bool:
        """Whether every metric with a tolerance is within it; NaN is not."""
        limits = self.ground_truth_tolerances if is_ground_truth else self.tolerances
        return all(metrics[name] <= limit for name, limit in limits.items())

    def supports(self, dynamics: Dynamics) -> bool:
        """Whether the case can run on it."""
        fits = isinstance(dynamics, NeRDDynamics) or not self.needs_model
        return fits and self.applies(dynamics.scene)


CASES: dict[str, Case] = {}
"""Every case by name, filled by `hard_case`."""


def hard_case(
    tolerances: Metrics,
    ground_truth: Metrics | None = None,
    applies: Callable[[Scene], bool] = lambda scene: True,
    needs_model: bool = False,
) -> Callable[[Callable[[Trial], Metrics]], Callable[[Trial], Metrics]]:
    """Register a function as the case of its name; its docstring says the physics.

    Args:
        tolerances: largest allowed metrics.
        ground_truth: the same for MuJoCo; by default those of the tested dynamics.
        applies: whether the case makes sense for a robot.
        needs_model: whether it asks for a model with a network; MuJoCo is left out then.
    """
    limits = tolerances if ground_truth is None else ground_truth
    limits = {} if needs_model else limits

    def register(run: Callable[[Trial], Metrics]) -> Callable[[Trial], Metrics]:
        physics = " ".join((run.__doc__ or "").split())
        about = (run.__name__, physics, run, applies, tolerances, limits, needs_model)
        CASES[run.__name__] = Case(*about)
        return run

    return register


def has_floating_base(scene: Scene) -> bool:
    """Whether the base moves freely."""
    return scene.base.is_floating


def has_motors(scene: Scene) -> bool:
    """Whether there is a torque to drive with."""
    return bool(len(scene.actuated))


def largest(value: Tensor) -> float:
    """The largest entry; infinity if any is not finite, or there is none."""
    is_valid = value.numel() and value.isfinite().all()
    return float(value.max()) if is_valid else float("inf")


def norm(x: Tensor) -> Tensor:
    """Length of vectors ``(*batch, D)``."""
    return torch.linalg.vector_norm(x, dim=-1)


def relative_difference(x: Tensor, other: Tensor) -> float:
    """Largest ``|x - other| / (1 + max |x|)`` of trajectories ``(n, steps, D)``."""
    size = 1.0 + x.abs().amax((1, 2), keepdim=True)  # (n, 1, 1)
    return largest(((other - x) / size).abs())
