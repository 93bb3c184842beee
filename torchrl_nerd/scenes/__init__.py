"""Scenes: a robot, its ground, its controller and its sampling ranges."""

from functools import cache
from pathlib import Path

from torchrl_nerd.scenes.importer import suite_name
from torchrl_nerd.scenes.scene import Scene


def is_import(name: str) -> bool:
    """Whether a name has the form of a third-party robot's; see `import_scene`."""
    origins = ("dm_control/", "gymnasium/")
    return isinstance(name, str) and (name.startswith(origins) or name.endswith(".xml"))


def import_scene(name: str) -> Scene:
    """The third-party robot of that name; the same object until its file changes.

    Such as ``dm_control/DOMAIN-TASK``, ``gymnasium/ID`` or the path of an MJCF file. With
    ``dm_control/DOMAIN-TASK/4`` a control step is four of the suite's.

    Raises:
        ValueError: no such robot, or one with something not supported (named).
    """
    file = Path(name).absolute() if name.endswith(".xml") else None
    return _import(name, file, file.stat().st_mtime_ns if file and file.exists() else 0)


@cache
def _import(name: str, file: Path | None, changed: int) -> Scene:
    """The same of an absolute path and the time of its last change, ns."""
    if name.endswith(".xml"):
        return Scene.from_mjcf(name)
    origin, _, rest = name.partition("/")
    if origin == "gymnasium":
        return Scene.from_gymnasium(rest)
    return Scene.from_dm_control(*suite_name(name))


__all__ = ["Scene", "import_scene", "is_import"]
