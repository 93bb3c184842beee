"""A hard case: physics with a known outcome, and tolerances for what is measured."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import torch
from tensordict import TensorDict
from torch import Generator, Tensor

from torchrl_nerd.dynamics import MujocoDynamics, NeRDDynamics
from torchrl_nerd.evaluation.rollout_error import position_errors
from torchrl_nerd.evaluation.stability import states
from torchrl_nerd.evaluation.stability.stepper import DynamicsStepper, Stepper
from torchrl_nerd.keys import QPOS
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.scenes import Scene

Metrics = dict[str, float]
"""What a case measured, by name with its unit."""

Needs = Literal["states", "dynamics", "model"]
"""What a case asks for: states alone, a `Dynamics`, or a model with a network."""


@dataclass(frozen=True)
class Trial:
    """One run of a case: what is stepped, and the random numbers.

    | field | meaning |
    |---|---|
    | ``stepper`` | the dynamics or the env under test |
    | ``generator`` | of starts and torques |
    | ``scale`` | fraction of long rollouts and large batches, in (0, 1] |
    """

    stepper: Stepper
    generator: Generator
    scale: float = 1.0

    @property
    def scene(self) -> Scene:
        """The robot."""
        return self.stepper.scene

    @property
    def model(self) -> NeRD:
        """The model, for cases that need one."""
        assert isinstance(self.stepper.dynamics, NeRDDynamics)
        return self.stepper.dynamics.model

    @cached_property
    def ground_truth(self) -> Stepper:
        """MuJoCo."""
        return DynamicsStepper(MujocoDynamics(self.scene))

    def scaled(self, count: int, least: int) -> int:
        """A number of steps or trajectories times the scale."""
        return max(least, round(self.scale * count))

    def starts(self, count: int) -> TensorDict:
        """States ``[count]`` from the scene's training range."""
        return states.sample_states(self.scene, count, self.generator)

    def settled(self, count: int) -> TensorDict:
        """Up to ``count`` states at rest, see `settled_states`."""
        return states.settled_states(self.scene, count).clone()

    def in_air(self, count: int) -> TensorDict:
        """States ``[count]`` that nothing touches."""
        return states.clear_of_ground(self.scene, self.starts(count))

    def torques(self, count: int, steps: int) -> Tensor:
        """Torques in the training range, ``(count, steps, num_actuated)``."""
        return states.uniform_torque(self.scene, count, steps, self.generator)

    def uniform(self, *shape: int) -> Tensor:
        """Numbers from U(0, 1), float64."""
        return torch.rand(shape, generator=self.generator).double()

    def normal(self, *shape: int) -> Tensor:
        """Standard normal numbers, float64."""
        return torch.randn(shape, generator=self.generator, dtype=torch.float64)

    def difference(self, path: TensorDict, other: TensorDict) -> Tensor:
        """Largest difference of all position quantities, m or rad, ``(n, steps)``."""
        errors = position_errors(self.scene, path[QPOS], other[QPOS])
        return torch.stack(list(errors.values())).amax(0)

    @property
    def roll(self) -> Callable[..., TensorDict]:
        """See `Stepper.roll`."""
        return self.stepper.roll


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
    | ``needs`` | what it asks for |

    A metric without a tolerance is for information.
    """

    name: str
    physics: str
    run: Callable[[Trial], Metrics]
    applies: Callable[[Scene], bool] = lambda scene: True
    tolerances: Metrics = field(default_factory=dict)
    ground_truth_tolerances: Metrics = field(default_factory=dict)
    needs: Needs = "states"

    def passes(self, metrics: Metrics, is_ground_truth: bool) -> bool:
        """Whether every metric with a tolerance is within it; NaN is not."""
        limits = self.ground_truth_tolerances if is_ground_truth else self.tolerances
        return all(metrics[name] <= limit for name, limit in limits.items())

    def supports(self, stepper: Stepper) -> bool:
        """Whether the case can run on it."""
        if not self.applies(stepper.scene):
            return False
        if self.needs == "model":
            return isinstance(stepper.dynamics, NeRDDynamics)
        return self.needs == "states" or stepper.dynamics is not None


CASES: dict[str, Case] = {}
"""Every case by name, filled by `hard_case`."""


def hard_case(
    applies: Callable[[Scene], bool] = lambda scene: True,
    tolerances: Metrics | None = None,
    ground_truth: Metrics | None = None,
    needs: Needs = "states",
) -> Callable[[Callable[[Trial], Metrics]], Callable[[Trial], Metrics]]:
    """Register a function as the case of its name; its docstring says the physics.

    Args:
        applies: whether the case makes sense for a robot.
        tolerances: largest allowed metrics.
        ground_truth: the same for MuJoCo; by default those of the tested dynamics.
        needs: what the case asks for; MuJoCo is left out where that is a model.
    """
    allowed = tolerances or {}
    exact = allowed if ground_truth is None else ground_truth

    def register(run: Callable[[Trial], Metrics]) -> Callable[[Trial], Metrics]:
        name, physics = run.__name__, " ".join((run.__doc__ or "").split())
        limits = {} if needs == "model" else exact
        CASES[name] = Case(name, physics, run, applies, allowed, limits, needs)
        return run

    return register


def has_floating_base(scene: Scene) -> bool:
    """Whether the base moves freely."""
    return scene.base.is_floating


def has_motors(scene: Scene) -> bool:
    """Whether there is a torque to drive with."""
    return bool(len(scene.actuated))


def has_level_ground(scene: Scene) -> bool:
    """Whether a floating base moves over one fixed plane."""
    plane = scene.terrain is not None and scene.terrain.fixed_plane is not None
    return has_floating_base(scene) and plane
