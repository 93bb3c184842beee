"""Scenes: a robot, its ground, its controller and its sampling ranges."""

from functools import cache
from pathlib import Path

import mujoco

from torchrl_nerd.scenes.importer import suite_name
from torchrl_nerd.scenes.scene import Scene


def is_import(name: str) -> bool:
    """Whether a name has the form of a third-party robot's; see `import_scene`."""
    origins = ("dm_control/", "gymnasium/")
    return isinstance(name, str) and (name.startswith(origins) or name.endswith(".xml"))


def import_scene(name: str) -> Scene:
    """The third-party robot of that name; the same object until a file of its changes.

    Such as ``dm_control/DOMAIN-TASK``, ``gymnasium/ID`` or the path of an MJCF file. With
    ``dm_control/DOMAIN-TASK/4`` a control step is four of the suite's.

    Raises:
        ValueError: no such robot, or one with something not supported (named).
    """
    return _import(name, _files(name))


def _files(name: str) -> tuple[tuple[Path, int], ...]:
    """Files of an MJCF robot, those it includes and meshes, and their last changes, ns."""
    if not name.endswith(".xml"):
        return ()
    path = Path(name).absolute()
    try:
        files = [Path(file) for file in mujoco.mju_getXMLDependencies(str(path))]
    except mujoco.FatalError:  # no MJCF: the import says what is wrong
        files = [path]
    return tuple((x, x.stat().st_mtime_ns) for x in sorted(files) if x.exists())


@cache
def _import(name: str, files: tuple[tuple[Path, int], ...]) -> Scene:
    """The same; ``files`` tell whether it was read before as it is now."""
    if name.endswith(".xml"):
        return Scene.from_mjcf(name)
    origin, _, rest = name.partition("/")
    if origin == "gymnasium":
        return Scene.from_gymnasium(rest)
    return Scene.from_dm_control(*suite_name(name))


__all__ = ["Scene", "import_scene", "is_import"]
