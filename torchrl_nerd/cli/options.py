"""Options that several commands share, and the scenes that they name."""

from collections.abc import Sequence
from dataclasses import dataclass
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
Vary = Annotated[
    tuple[str, ...],
    tyro.conf.arg(
        help="Hidden parameters that differ from trajectory to trajectory, as "
        "mass:pole=0.3:3.0 (KIND:TARGET=LOW:HIGH), or preset: those of the robot's preset."
    ),
]


def varied_ranges(name: str, vary: Sequence[str]) -> dict[str, Sequence[float]]:
    """Parameters and ranges of a robot by what ``--vary`` says.

    Raises:
        ValueError: not ``NAME=LOW:HIGH``, a name that is given twice, or no preset.
    """
    ranges = dict[str, Sequence[float]]()
    names = [given.partition("=")[0] for given in vary]
    for parameter in names:
        if names.count(parameter) > 1:
            raise ValueError(f"expected '{parameter}' once, got it several times")
    if "preset" in names:
        if not (preset := preset_of(name).variation):
            raise ValueError(
                f"expected NAME=LOW:HIGH for '{name}', which has no preset to vary"
            )
        ranges |= preset  # what is given beside it counts
    for parameter, given in zip(names, vary, strict=True):
        if given == "preset":
            continue
        try:
            low, high = map(float, given.partition("=")[2].split(":"))
        except ValueError:
            raise ValueError(f"expected NAME=LOW:HIGH, got '{given}'") from None
        ranges[parameter] = low, high
    return ranges


@dataclass(frozen=True, kw_only=True)
class SceneOptions:
    """Options of commands that draw data of a robot or learn it."""

    scene: Positional[SceneName]
    reference: Literal["rk4"] | None = None
    """Reference solver in place of the scene's own: MuJoCo's RK4 at four times its
    substeps."""
    vary: Vary = ()

    def load(self) -> Scene:
        """The scene with its own or the reference solver, and with what varies."""
        scene, ranges = load_scene(self.scene), varied_ranges(self.scene, self.vary)
        scene = scene.reference if self.reference else scene
        return scene.vary(ranges) if ranges else scene

    @property
    def run_name(self) -> str:
        """The folder under ``datasets`` and ``runs`` that belongs to it."""
        varied = "varied" if self.vary else None
        return "-".join(filter(None, (folder_name(self.scene), self.reference, varied)))


def recorded_scene(name: str) -> Scene:
    """The scene that recordings of a robot are of: ``cube_real`` for ``cube``."""
    return load_scene(recorded_protocol(name).scene)
