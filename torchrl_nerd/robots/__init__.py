"""Robots, a folder each, registered by being there: the ``ROBOT`` of ``presets.py``.

Robots of users are registered by `register`.
"""

from collections.abc import Collection
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules

from torchrl_nerd.configs import DataConfig, TrainConfig
from torchrl_nerd.robots.registry import (
    NOT_LOADED,
    PPO_CONFIGS,
    PRESETS,
    SCENES,
    TASKS,
    register,
)
from torchrl_nerd.robots.robot import (
    EvaluationProtocol,
    Preset,
    RecordedProtocol,
    Robot,
    Source,
)
from torchrl_nerd.scenes import Scene, import_scene, is_import
from torchrl_nerd.settings import did_you_mean
from torchrl_nerd.tasks import SceneTask, Task
from torchrl_nerd.tasks.locomotion import TASKS as LOCOMOTION
from torchrl_nerd.tasks.locomotion import LocomotionTask
from torchrl_nerd.tasks.suite import SuiteTask

ROBOTS: dict[str, Robot] = {
    found.name: import_module(f"{__name__}.{found.name}.presets").ROBOT
    for found in iter_modules(__path__)
    if found.ispkg
}
for _robot in ROBOTS.values():
    register(_robot)
THIRD_PARTY = Preset(  # an MLP on single states; nothing is tuned
    protocol=None,
    data=DataConfig(trajectories=10_000, steps=100),
    train=TrainConfig(
        network="mlp-4x128-products",
        symmetries=0,
        steps=10_000,
        rollout_steps=500,
        single_step_fraction=1.0,
        loss_eps=0.02,
    ),
)


def load_scene(name: str | Path) -> Scene:
    """The scene of that name; the same object at every call, until its file changes.

    Args:
        name: a registered one, ``dm_control/DOMAIN-TASK``, ``gymnasium/ID`` or the path
            of an MJCF file.

    Raises:
        ValueError: no such scene, one registered as something else, or a robot with
            something not supported (named).
    """
    name = str(name) if isinstance(name, Path) else name
    if isinstance(name, str) and name in SCENES:
        scene = SCENES[name]()
        if not isinstance(scene, Scene) or scene.name != name:
            got = f"'{scene.name}'" if isinstance(scene, Scene) else repr(scene)
            raise ValueError(f"expected a Scene with the name '{name}', got {got}")
        return scene
    if is_import(name):
        return import_scene(name)
    raise _unknown("scene", name, SCENES)


def make_task(name: str | Path | Scene | Task) -> Task:
    """The task of that id: a registered one or ``dm_control/DOMAIN-TASK``.

    So is ``gymnasium/ID`` where the environment runs along x, see `LocomotionTask`. Other
    ids of Gymnasium, MJCF files and scenes are a robot alone, which becomes a `SceneTask`.
    A task is returned as it is.

    Raises:
        ValueError: no such task, one registered as something else, or a robot with
            something not supported (named).
    """
    if isinstance(name, Task):
        return name
    if isinstance(name, Scene):
        return SceneTask(name)
    name = str(name) if isinstance(name, Path) else name
    if isinstance(name, str) and name in TASKS:
        task = TASKS[name]()
        if not isinstance(task, Task):
            raise ValueError(f"expected a Task by the id '{name}', got {task!r}")
        return task
    if is_import(name):
        if name.startswith("dm_control/"):
            return SuiteTask(name)
        runs = name.removeprefix("gymnasium/") in LOCOMOTION
        return LocomotionTask(name) if runs else SceneTask(import_scene(name))
    raise _unknown("task", name, TASKS)


def _unknown(what: str, name: object, known: Collection[str]) -> ValueError:
    """No such scene or task; which one was meant, and what of ``NERD_ROBOTS`` failed."""
    given = str(name)
    of_scene = [other for other in known if other.startswith(f"{given}/")]
    of_task = [other for other in known if given.startswith(f"{other}/")]
    meant = did_you_mean(given, known, (*of_scene, *of_task))
    return ValueError(
        f"unknown {what} {name!r}{meant}, expected one of {', '.join(known)}, "
        "dm_control/DOMAIN-TASK, gymnasium/ID or an MJCF file"
        + " (MuJoCo's `compile` makes one of a URDF)" * given.endswith(".urdf")
        + "".join(f"; {sentence}" for sentence in NOT_LOADED)
    )


def task_id(task: Task) -> str:
    """The id of a task, or the name of its class."""
    if isinstance(task, SuiteTask | LocomotionTask) or type(task) is SceneTask:
        return task.name
    ids = (name for name, kind in TASKS.items() if kind is type(task))
    return next(ids, type(task).__name__)


def preset_of(name: str) -> Preset:
    """The preset of the scene of that name; one for all third-party robots."""
    return PRESETS.get(name, THIRD_PARTY)


def protocol_of(scene: Scene) -> EvaluationProtocol:
    """The test rollouts of a registered scene, or of a third-party robot.

    The latter starts within its own sampling ranges, once with zero actions and once, if
    it has actuators, with random ones.
    """
    if (known := preset_of(scene.name).protocol) is not None:
        return known
    is_driven = scene.controller.num_actions > 0
    names = ("passive", "random") if is_driven else ("passive",)
    cases: dict[str, Source] = {name: scene for name in names}
    return EvaluationProtocol(cases, (20, 100), random_actions=names[1:])


def recorded_protocol(name: str) -> RecordedProtocol:
    """What goes with recordings of the robot of that name."""
    return preset_of(name).recorded or RecordedProtocol(name, name)


def source_of(scene: Scene) -> Source:
    """Whose initial states validate models of a scene: its preset's task, or itself."""
    name = preset_of(scene.name).task
    if name is None:
        return scene
    task = make_task(name)
    return task if scene.variation is None else task.vary(scene.variation.ranges)


__all__ = [
    "PPO_CONFIGS",
    "PRESETS",
    "ROBOTS",
    "SCENES",
    "TASKS",
    "EvaluationProtocol",
    "Preset",
    "Robot",
    "Source",
    "load_scene",
    "make_task",
    "preset_of",
    "protocol_of",
    "recorded_protocol",
    "register",
    "source_of",
    "task_id",
]
