"""Options that several commands share, and the scenes that they name."""

from collections.abc import Sequence
from typing import Annotated, Literal

import tyro

from torchrl_nerd.files import folder_name
from torchrl_nerd.robots import load_scene, preset_of, recorded_protocol
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
Vary = Annotated[
    tuple[str, ...],
    tyro.conf.arg(
        help="Hidden parameters that differ from trajectory to trajectory, as "
        "mass:pole=0.3:3.0 (KIND:TARGET=LOW:HIGH), or preset: those of the robot's preset."
    ),
]


def scene_of(name: str, reference: str | None, vary: tuple[str, ...] = ()) -> Scene:
    """A scene by its name, with its own or the reference solver, see `Scene.reference`.

    ``vary``: hidden parameters, see `Variation`.

    Raises:
        ValueError: no such scene, parameter or range.
    """
    scene = load_scene(name)
    ranges: dict[str, Sequence[float]] = {}
    for given in vary:
        if given == "preset":
            if not preset_of(name).variation:
                raise ValueError(
                    f"expected NAME=LOW:HIGH for '{name}', which has no preset to vary"
                )
            ranges |= preset_of(name).variation
            continue
        parameter, _, ends = given.partition("=")
        try:
            low, high = map(float, ends.split(":"))
        except ValueError:
            raise ValueError(f"expected NAME=LOW:HIGH, got '{given}'") from None
        if parameter in {name.partition("=")[0] for name in vary if name != given}:
            raise ValueError(f"expected '{parameter}' once, got it several times")
        ranges[parameter] = low, high
    scene = scene.reference if reference else scene
    return scene.vary(ranges) if ranges else scene


def run_name(name: str, reference: str | None, vary: tuple[str, ...] = ()) -> str:
    """The folder under ``datasets`` and ``runs`` that belongs to it."""
    about = [
        word for word, is_so in ((reference, reference), ("varied", vary)) if is_so
    ]
    return "-".join((folder_name(name), *map(str, about)))


def recorded_scene(name: str) -> Scene:
    """The scene that recordings of a robot are of: ``cube_real`` for ``cube``."""
    return load_scene(recorded_protocol(name).scene)
