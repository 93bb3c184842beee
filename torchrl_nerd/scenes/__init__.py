"""Scenes: robots with their ground, controller and sampling ranges."""

from collections.abc import Callable
from functools import cache

from torchrl_nerd.scenes.ant import ant
from torchrl_nerd.scenes.anymal import anymal
from torchrl_nerd.scenes.cartpole import cartpole
from torchrl_nerd.scenes.cube import cube
from torchrl_nerd.scenes.cube_real import cube_real
from torchrl_nerd.scenes.cube_slope import cube_slope
from torchrl_nerd.scenes.double_pendulum import double_pendulum
from torchrl_nerd.scenes.franka import franka
from torchrl_nerd.scenes.franka_gravity import franka_gravity
from torchrl_nerd.scenes.scene import Scene

SCENES: dict[str, Callable[[], Scene]] = {
    "cartpole": cartpole,
    "double_pendulum": double_pendulum,
    "ant": ant,
    "franka": franka,
    "franka_gravity": franka_gravity,
    "anymal": anymal,
    "cube": cube,
    "cube_real": cube_real,
    "cube_slope": cube_slope,
}


def is_import(name: str) -> bool:
    """Whether a name is of the form of a robot of others; see `load_scene`."""
    return name.startswith(("dm_control/", "gymnasium/")) or name.endswith(".xml")


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
    origin, _, rest = name.partition("/")
    domain, _, task = rest.partition("-")
    if origin == "dm_control" and task:
        return Scene.from_dm_control(domain, task)
    if origin == "gymnasium" and rest:
        return Scene.from_gymnasium(rest)
    if name.endswith(".xml"):
        return Scene.from_mjcf(name)
    raise ValueError(
        f"unknown scene {name!r}, expected one of {', '.join(SCENES)}, "
        "dm_control/DOMAIN-TASK, gymnasium/ID or an MJCF file"
    )


__all__ = ["SCENES", "Scene", "is_import", "load_scene"]
