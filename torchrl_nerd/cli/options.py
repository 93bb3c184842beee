"""Options that several commands share, and the scenes that they name."""

from typing import Annotated, Literal

import tyro

from torchrl_nerd.files import folder_name
from torchrl_nerd.robots import load_scene, recorded_protocol
from torchrl_nerd.scenes import Scene

Positional = tyro.conf.Positional
Flat = tyro.conf.OmitArgPrefixes
SceneName = Annotated[
    str,
    tyro.conf.arg(
        help="Name of the robot: cartpole, ant, dm_control/DOMAIN-TASK, gymnasium/ID, or "
        "an MJCF file."
    ),
]
ModelName = Annotated[
    str | None,
    tyro.conf.arg(
        help="nerd, hybrid, analytic, the name of a shipped model, or a checkpoint folder; "
        "by default what is shipped for the robot."
    ),
]
Reference = Annotated[
    Literal["rk4"] | None,
    tyro.conf.arg(
        help="Reference solver in place of the scene's own: MuJoCo's RK4 at four times its "
        "substeps."
    ),
]


def scene_of(name: str, reference: str | None) -> Scene:
    """A scene by its name, with its own or the reference solver, see `Scene.reference`."""
    scene = load_scene(name)
    return scene.reference if reference else scene


def run_name(name: str, reference: str | None) -> str:
    """The folder under ``datasets`` and ``runs`` that belongs to it."""
    return "-".join((folder_name(name), *((reference,) if reference else ())))


def recorded_scene(name: str) -> Scene:
    """The scene that recordings of a robot are of: ``cube_real`` for ``cube``."""
    return load_scene(recorded_protocol(name).scene)
