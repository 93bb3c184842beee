"""What several commands share: kinds of options, and the scene of a recording."""

import tyro

from torchrl_nerd.data.recorded import REAL
from torchrl_nerd.files import folder_name
from torchrl_nerd.robots import load_scene
from torchrl_nerd.scenes import Scene

Positional = tyro.conf.Positional
Flat = tyro.conf.OmitArgPrefixes


def scene_of(name: str, reference: str | None) -> Scene:
    """A scene by its name, with its own or the reference solver, see `Scene.reference`."""
    scene = load_scene(name)
    return scene.reference if reference else scene


def run_name(name: str, reference: str | None) -> str:
    """The folder under ``datasets`` and ``runs`` that belongs to it."""
    return "-".join((folder_name(name), *((reference,) if reference else ())))


def real_scene(name: str) -> Scene:
    """The scene that recorded tosses are of; ``cube`` is short for it.

    Raises:
        ValueError: another robot.
    """
    if name not in REAL:
        expected = " or ".join(REAL)
        raise ValueError(f"expected {expected} for recorded tosses, got '{name}'")
    return load_scene(REAL[name])
