"""All robots by their names: those of the package, and those that users register."""

import os
import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

from torchrl_nerd.configs import PPOConfig
from torchrl_nerd.robots.robot import Preset, Robot
from torchrl_nerd.scenes import Scene, is_import
from torchrl_nerd.tasks import Task

RESERVED = ("nerd", "hybrid", "analytic", "mujoco", "dm_control", "mujoco_warp")
PRETRAINED = Path(__file__).parents[1] / "pretrained"  # models of the package
VARIABLE = "NERD_ROBOTS"
"""Environment variable: modules or files that register robots, separated as in PATH."""

SCENES: dict[str, Callable[[], Scene]] = {}
TASKS: dict[str, Callable[[], Task]] = {}
PRESETS: dict[str, Preset] = {}
PPO_CONFIGS: dict[str, PPOConfig] = {}
MODELS: dict[str, Path] = {}
"""Folders of models of users' robots; a folder may be filled later."""
POLICIES: dict[str, Path] = {}
"""Task id -> folder of its policy, of users' robots; a folder may be filled later."""

TABLES: dict[str, dict[str, Any]] = {
    "scenes": SCENES,
    "tasks": TASKS,
    "presets": PRESETS,
    "ppo": PPO_CONFIGS,
    "models": MODELS,
    "policies": POLICIES,
}
"""Field of `Robot` -> what is known of it, of all robots."""
NOT_LOADED: list[str] = []
"""A sentence for each entry of ``NERD_ROBOTS`` that could not be loaded."""
_LISTENERS: list[Callable[[str], object]] = []
_LAST: dict[str, Robot] = {}  # of each scene: what it was last registered with


def register(robot: Robot) -> None:
    """Make a robot known by its names: to `make_env`, Gymnasium and every command.

    Nothing is built yet: a scene or task is, when its name is first asked for. Commands
    and worker processes find a robot whose module ``NERD_ROBOTS`` names. A module that is
    loaded again replaces its robot with all its names, as a cell of a notebook does.

    Raises:
        TypeError: no robot, or a field that holds something else than it should.
        ValueError: a name that is taken, or does not go with the scenes.
    """
    if not isinstance(robot, Robot):
        raise TypeError(f"expected a Robot to register, got {type(robot).__name__}")
    _check_types(robot)
    _check_names(robot)
    is_again = all(_is_again(scene, SCENES.get(s)) for s, scene in robot.scenes.items())
    for field, table in TABLES.items():
        taken = [name for name in getattr(robot, field) if name in table]
        if taken and not is_again:
            raise ValueError(
                f"'{taken[0]}' is among the {field} of another robot: expected a new name"
            )
    before = [_LAST[scene] for scene in robot.scenes if scene in _LAST]
    for field, table in TABLES.items():
        for name in (name for old in before for name in getattr(old, field)):
            table.pop(name, None)
        table.update(getattr(robot, field))
    for scene in (scene for old in before for scene in old.scenes):
        _LAST.pop(scene, None)
    _LAST.update(dict.fromkeys(robot.scenes, robot))
    told = dict.fromkeys(task for each in (*before, robot) for task in each.tasks)
    for listener in _LISTENERS:
        for task in told:
            listener(task)


def for_each_task(function: Callable[[str], object]) -> None:
    """Call a function with the id of every task, of those that are registered later too.

    It is called once more with the id of a task that is gone from `TASKS`.
    """
    _LISTENERS.append(function)
    for task in TASKS:
        function(task)


def load_named_robots() -> None:
    """Import what ``NERD_ROBOTS`` names: modules, or files and folders of Python code.

    What fails is told where a name is asked for that is unknown: a broken entry must not
    stop work with another robot.
    """
    for entry in filter(None, os.environ.get(VARIABLE, "").split(os.pathsep)):
        try:
            _load(entry)
        except Exception as error:  # whatever a user's file may raise
            reason = f"{type(error).__name__}: {error}".splitlines()[0]
            NOT_LOADED.append(f"{VARIABLE} names '{entry}', which fails with {reason}")


def _load(entry: str) -> None:
    """Import a module, or a file or folder; another module of its name is refused."""
    if not (path := Path(entry)).exists():
        import_module(entry)
        return
    sys.path.insert(0, str(path.resolve().parent))
    found = Path(import_module(path.stem).__file__ or path).resolve()
    if path.resolve() not in (found, found.parent):
        raise ImportError(f"another module has its name, {found}")


def _is_again(scene: Callable, known: Callable | None) -> bool:
    """Whether a function is the known one of the same module and name, loaded again."""
    one, other = (
        (getattr(x, "__module__", None), getattr(x, "__qualname__", "<"))
        for x in (scene, known)
    )
    return one == other and "<" not in one[1]  # neither local nor a lambda


def _check_types(robot: Robot) -> None:
    expected: dict[str, tuple[Any, str]] = {
        "scenes": (Callable, "functions that return a Scene"),
        "tasks": (Callable, "subclasses of Task"),
        "presets": (Preset, "a Preset"),
        "ppo": (PPOConfig, "a PPOConfig"),
        "models": (str | Path, "a folder"),
        "policies": (str | Path, "a folder"),
    }
    for field, (kind, words) in expected.items():
        given = getattr(robot, field)
        if not isinstance(given, Mapping):
            raise TypeError(f"expected names and {words} as {field}, got {given!r}")
        for name, value in given.items():
            if not isinstance(name, str) or not isinstance(value, kind):
                raise TypeError(f"expected {words} as {field}, got {name!r}: {value!r}")


def _check_names(robot: Robot) -> None:
    scenes = robot.scenes
    bad = [s for s in scenes if not s or "/" in s or is_import(s) or s in RESERVED]
    if bad or not scenes:
        found = repr(bad[0]) if bad else "none"
        raise ValueError(
            "expected names of scenes without / or .xml that are no kind of dynamics "
            f"({', '.join(RESERVED)}), got {found}"
        )

    # names that fit, and beginnings of them; a scene's name may hold a dash
    tasks = tuple(f"{scene}/" for scene in scenes)
    kinds = tuple(f"{scene}-" for scene in scenes)
    rules = {
        "tasks": ("SCENE/TASK of its scenes", scenes, (), tasks),
        "presets": ("SCENE of its scenes", scenes, scenes, ()),
        "models": ("SCENE or SCENE-KIND of its scenes", scenes, scenes, kinds),
        "ppo": ("its tasks", robot.tasks, robot.tasks, ()),
        "policies": ("its tasks", robot.tasks, robot.tasks, ()),
    }
    for field, (form, listed, names, starts) in rules.items():
        for name in getattr(robot, field):
            if name not in names and not name.startswith(starts) or name.endswith("/"):
                known = ", ".join(listed) or "none"
                raise ValueError(f"expected {form} ({known}) as {field}, got '{name}'")
    shipped = [name for name in robot.models if (PRETRAINED / name).exists()]
    if shipped:
        raise ValueError(
            f"'{shipped[0]}' is a model of the package: expected a new name"
        )
