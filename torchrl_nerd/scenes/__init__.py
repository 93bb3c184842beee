"""Scenes: robots with their ground, controller and sampling ranges."""

from collections.abc import Callable
from functools import cache

from torchrl_nerd.scenes.ant import ant
from torchrl_nerd.scenes.anymal import anymal
from torchrl_nerd.scenes.cartpole import cartpole
from torchrl_nerd.scenes.cube import cube
from torchrl_nerd.scenes.cube_real import cube_real
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
}


@cache
def load_scene(name: str) -> Scene:
    """The registered scene of that name; the same object at every call.

    Raises:
        ValueError: no such scene.
    """
    if name not in SCENES:
        raise ValueError(f"unknown scene '{name}', expected one of {', '.join(SCENES)}")
    return SCENES[name]()


__all__ = ["SCENES", "Scene", "load_scene"]
