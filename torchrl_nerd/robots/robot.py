"""What a robot's ``presets.py`` gives: its scenes, its tasks and its presets."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal

from torchrl_nerd.configs import DataConfig, PPOConfig, TrainConfig
from torchrl_nerd.scenes import Scene
from torchrl_nerd.tasks import Task

Source = Task | Scene
"""Whose starts and controller a rollout has: a task's, or a scene's sampling ranges."""


@dataclass(frozen=True)
class EvaluationProtocol:
    """Open-loop rollouts that measure a scene.

    The action is zero, and the task's controller turns it into torque: none where the
    action is a torque (passive motion), a PD controller about the nominal pose for ANYmal.

    | field | meaning |
    |---|---|
    | ``cases`` | name -> task or scene whose resets or ranges give the initial states |
    | ``horizons`` | control steps over which errors are averaged |
    | ``published`` | (case, horizon, quantity) -> the paper's mean error, m or rad |
    | ``random_actions`` | cases with uniform actions in [-1, 1] in place of zero |
    """

    cases: Mapping[str, Source]
    horizons: tuple[int, ...]
    published: Mapping[tuple[str, int, str], float] = field(default_factory=dict)
    random_actions: tuple[str, ...] = ()


@dataclass(frozen=True)
class RecordedProtocol:
    """What goes with recordings of a robot.

    | field | meaning |
    |---|---|
    | ``scene`` | name of the scene that has the recorded robot's mass and frame rate |
    | ``model`` | shipped model that was fitted to such recordings |
    | ``parameters`` | published physical parameters, SI units, where a fit begins |
    | ``published`` | what -> error, such as ``position_error_m`` -> mean, m or rad |
    """

    scene: str
    model: str
    parameters: Mapping[str, float] = field(default_factory=dict)
    published: Mapping[str, Mapping[str, float]] = field(default_factory=dict)


@dataclass(frozen=True)
class Preset:
    """How the models of one scene are made and measured.

    | field | meaning |
    |---|---|
    | ``protocol`` | its test rollouts; None: within the scene's sampling ranges |
    | ``data`` | how much training data |
    | ``train`` | how its learned model is trained |
    | ``hybrid`` | how its hybrid is trained; None where learning does not help the step |
    | ``task`` | its resets start the validation; None: the scene's sampling ranges |
    | ``strategy`` | how training states are drawn, see `data.strategies`; None: from the
      scene's sampling ranges |
    | ``exports`` | which checkpoint of a run is the model: the best one or the last |
    | ``unseen_terrain`` | test rollouts over kinds of ground that no training data have |
    | ``recorded`` | what goes with recordings of it |
    """

    protocol: EvaluationProtocol | None
    data: DataConfig
    train: TrainConfig
    hybrid: TrainConfig | None = None
    task: str | None = None
    strategy: str | None = None
    exports: Literal["best", "last"] = "best"
    unseen_terrain: EvaluationProtocol | None = None
    recorded: RecordedProtocol | None = None


@dataclass(frozen=True)
class Robot:
    """One robot, in one or more scenes.

    | field | meaning |
    |---|---|
    | ``scenes`` | name -> builder, which returns the same scene at every call |
    | ``tasks`` | ``scene/task`` -> class |
    | ``presets`` | scene name -> its preset |
    | ``ppo`` | task id -> settings of PPO, for tasks with a goal |
    """

    scenes: Mapping[str, Callable[[], Scene]]
    tasks: Mapping[str, Callable[[], Task]]
    presets: Mapping[str, Preset]
    ppo: Mapping[str, PPOConfig] = field(default_factory=dict)
