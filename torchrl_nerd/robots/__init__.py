"""Robots, a folder each: a folder with a ``ROBOT`` is registered by being there."""

from collections.abc import Callable, Mapping
from functools import cache
from importlib import import_module
from pkgutil import iter_modules

from torchrl_nerd.configs import DataConfig, PPOConfig, TrainConfig
from torchrl_nerd.robots.robot import (
    EvaluationProtocol,
    Preset,
    RecordedProtocol,
    Robot,
    Source,
)
from torchrl_nerd.scenes import Scene, import_scene, is_import
from torchrl_nerd.tasks import Task
from torchrl_nerd.tasks.suite import SuiteTask

ROBOTS: Mapping[str, Robot] = {
    found.name: import_module(f"{__name__}.{found.name}").ROBOT
    for found in iter_modules(__path__)
    if found.ispkg
}
SCENES: Mapping[str, Callable[[], Scene]] = {
    name: build for robot in ROBOTS.values() for name, build in robot.scenes.items()
}
TASKS: Mapping[str, Callable[[], Task]] = {
    name: make for robot in ROBOTS.values() for name, make in robot.tasks.items()
}
PRESETS: Mapping[str, Preset] = {
    name: preset for robot in ROBOTS.values() for name, preset in robot.presets.items()
}
PPO_CONFIGS: Mapping[str, PPOConfig] = {
    task: config for robot in ROBOTS.values() for task, config in robot.ppo.items()
}


@cache
def load_scene(name: str) -> Scene:
    """The scene of that name; the same object at every call.

    Args:
        name: a registered one, ``dm_control/DOMAIN-TASK``, ``gymnasium/ID`` or the path
            of an MJCF file.

    Raises:
        ValueError: no such scene, or a robot with something not supported (named).
    """
    if name in SCENES:
        return SCENES[name]()
    if is_import(name):
        return import_scene(name)
    raise ValueError(
        f"unknown scene {name!r}, expected one of {', '.join(SCENES)}, "
        "dm_control/DOMAIN-TASK, gymnasium/ID or an MJCF file"
    )


def make_task(name: str) -> Task:
    """The task of that id: a registered one or ``dm_control/DOMAIN-TASK``.

    Raises:
        ValueError: no such task, or one whose robot has something not supported (named).
    """
    if name in TASKS:
        return TASKS[name]()
    if name.startswith("dm_control/"):
        return SuiteTask(name)
    raise ValueError(
        f"unknown task '{name}', expected one of {', '.join(TASKS)} or "
        "dm_control/DOMAIN-TASK"
    )


def preset_of(name: str) -> Preset:
    """The preset of the scene of that name; one for all third-party robots."""
    return PRESETS[name] if name in PRESETS else _third_party(name)


def protocol_of(scene: Scene) -> EvaluationProtocol:
    """The test rollouts of a registered scene, or of a third-party robot.

    The latter starts within its own sampling ranges, once with zero actions and once, if
    it has actuators, with random ones.
    """
    if scene.name in PRESETS:
        return PRESETS[scene.name].protocol()
    names = ("passive", "random") if scene.actuated else ("passive",)
    cases: dict[str, Source] = {name: scene for name in names}
    return EvaluationProtocol(cases, (20, 100), random_actions=names[1:])


def recorded_protocol(name: str) -> RecordedProtocol:
    """What goes with recordings of the robot of that name."""
    known = preset_of(name).recorded
    return RecordedProtocol(name, name) if known is None else known


def source_of(scene: Scene) -> Source:
    """Whose initial states validate models of a scene: its preset's task, or itself."""
    task = preset_of(scene.name).task
    return scene if task is None else make_task(task)


def _third_party(name: str) -> Preset:
    """An MLP on single states: nobody has tuned anything for this robot."""
    train = TrainConfig(
        network="mlp-4x128",
        steps=10_000,
        rollout_steps=500,
        single_step_fraction=1.0,
        loss_eps=0.02,
    )
    data = DataConfig(trajectories=10_000, steps=100)
    return Preset(lambda: protocol_of(load_scene(name)), data, train)


__all__ = [
    "PPO_CONFIGS",
    "PRESETS",
    "ROBOTS",
    "SCENES",
    "TASKS",
    "EvaluationProtocol",
    "Preset",
    "RecordedProtocol",
    "Robot",
    "Source",
    "load_scene",
    "make_task",
    "preset_of",
    "protocol_of",
    "recorded_protocol",
    "source_of",
]
