"""What a robot's ``presets.py`` gives: its scenes, its tasks and its presets."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from torchrl_nerd.configs import DataConfig, PPOConfig, TrainConfig
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.variation import Ranges
from torchrl_nerd.tasks import Task

Source = Task | Scene
"""Whose starts and controller a rollout has: a task's, or a scene's sampling ranges."""


# As in the paper's reference code (rl_games), except that its step size follows the
# policy's KL divergence; here it falls linearly.
WALKING_PPO = PPOConfig(num_envs=2048, minibatch=16_384, lr=3e-4, widths=(128, 64, 32))


@dataclass(frozen=True)
class EvaluationProtocol:
    """Open-loop rollouts that measure a scene.

    The action is zero, and the task's controller turns it into torque: none where the
    action is a torque (passive motion), a PD controller about the nominal pose for ANYmal.
    """

    cases: Mapping[str, Source]  # by name: whose resets or ranges give initial states
    horizons: tuple[int, ...]  # control steps over which errors are averaged
    # (case, horizon, quantity) -> the paper's mean error, m or rad
    published: Mapping[tuple[str, int, str], float] = field(default_factory=dict)
    random_actions: tuple[str, ...] = ()  # cases with actions uniform in [-1, 1]


@dataclass(frozen=True)
class RecordedProtocol:
    """What goes with recordings of a robot."""

    scene: str  # the scene that has the recorded robot's mass and frame rate
    model: str  # shipped model that was fitted to such recordings
    # published physical parameters, SI units, where a fit begins
    parameters: Mapping[str, float] = field(default_factory=dict)
    # method -> quantity, such as position_error_m -> mean error, m or rad
    published: Mapping[str, Mapping[str, float]] = field(default_factory=dict)


@dataclass(frozen=True)
class Preset:
    """How the models of one scene are made and measured."""

    protocol: EvaluationProtocol | None  # None: within the scene's sampling ranges
    data: DataConfig
    train: TrainConfig  # of its learned model
    hybrid: TrainConfig | None = None  # None where learning does not help the step
    task: str | None = None  # whose resets validate; None: the scene's sampling ranges
    strategy: str | None = None  # of training states, see `data.strategies`
    exports: Literal["best", "last"] = "best"  # the checkpoint that is the model
    recorded: RecordedProtocol | None = None
    # hidden parameters of adaptive models, and their ranges; see `Scene.vary`
    variation: Ranges = field(default_factory=dict)


@dataclass(frozen=True)
class Robot:
    """One robot, in one or more scenes."""

    scenes: Mapping[str, Callable[[], Scene]]  # builders: the same scene at every call
    # "scene/task" -> class
    tasks: Mapping[str, Callable[[], Task]] = field(default_factory=dict)
    presets: Mapping[str, Preset] = field(default_factory=dict)  # by the scene's name
    ppo: Mapping[str, PPOConfig] = field(default_factory=dict)  # of tasks with a goal
    # of a user's robot: "scene" (transformer), "scene-mlp" or "scene-hybrid" -> folder
    models: Mapping[str, Path] = field(default_factory=dict)
    policies: Mapping[str, Path] = field(default_factory=dict)  # "scene/task" -> folder
