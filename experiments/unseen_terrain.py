"""Error of the double pendulum's models on ground of kinds that no training data have.

    python experiments/unseen_terrain.py --json results/unseen_terrain.json

Two planes, the edge of a box, a height field and a flat field; only planes are trained on.
A contact point sees distance and normal of the nearest surface, whatever its shape, so the
trained weights run unchanged. They cannot see a surface that touches a link between its
contact points, as the edge of a box does. Nor do they know that MuJoCo gives a height
field one contact per prism that a cap dips into, so that its ground is several times
stiffer near seams: the flat field, terrain 1 of the paper, shows how much that matters.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from math import cos, pi, sin
from pathlib import Path

import mujoco
import numpy as np
import tyro
from torch import Tensor

from torchrl_nerd.cli.eval import Eval
from torchrl_nerd.evaluation.bench.candidates import models, simulators
from torchrl_nerd.evaluation.bench.errors import error_table
from torchrl_nerd.evaluation.results import write_results
from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.robots import load_scene
from torchrl_nerd.robots.double_pendulum.scene import (
    ASSET,
    CONTACT,
    SUBSTEPS,
    double_pendulum,
)
from torchrl_nerd.robots.double_pendulum.tasks import DoublePendulumPassive
from torchrl_nerd.robots.robot import EvaluationProtocol
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.penalty_law import set_penalty_contact

GEOM = mujoco.mjtGeom


@dataclass(frozen=True)
class Options:
    """What to measure, and where the results go."""

    num_trajectories: int = 2048
    """Trajectories per ground."""
    seed: int = 500
    """Of the initial states."""
    json: Path | None = None
    """Write the results to this file."""


def double_pendulum_over(add_ground: Callable[[mujoco.MjSpec], None]) -> Scene:
    """The double pendulum over a fixed ground of any shape, in place of the random plane.

    Args:
        add_ground: adds shapes to the world; whatever it adds touches the pendulum and
            has its contact parameters, as the plane does.
    """
    spec, trained = mujoco.MjSpec.from_file(str(ASSET)), double_pendulum()
    spec.delete(spec.body("ground"))
    add_ground(spec)
    for geom in spec.worldbody.geoms:
        geom.contype, geom.conaffinity = 1, 0
    model = spec.compile()
    set_penalty_contact(model, **CONTACT)
    fixed = {"ground": None, "level_ground": None, "clearance": 0.0}
    sampling = replace(trained.sampling, **fixed)
    return Scene(trained.name, model, SUBSTEPS, trained.controller, sampling)


class DoublePendulumOver(DoublePendulumPassive):
    """The passive double pendulum over a fixed ground; the same starts as over planes.

    Args:
        add_ground: see `double_pendulum_over`.
    """

    parameters = {}

    def __init__(self, add_ground: Callable[[mujoco.MjSpec], None]) -> None:
        super().__init__(ground=0)
        self.build_scene = partial(double_pendulum_over, add_ground)

    def initial_state(self, u: Tensor) -> dict[str, Tensor]:
        """``qpos`` and ``qvel (*batch, 2)`` as over planes, without an env's ground."""
        state = super().initial_state(u)
        return {key: state[key] for key in (QPOS, QVEL)}


def two_planes(spec: mujoco.MjSpec) -> None:
    """A valley: slopes of 15 and 30 degrees that meet 2.75 m below the root."""
    for tilt in (pi / 12, -pi / 6):
        quat = (cos(tilt / 2), 0.0, sin(tilt / 2), 0.0)
        where = {"pos": (0.0, 0.0, -0.75), "quat": quat}
        spec.worldbody.add_geom(type=GEOM.mjGEOM_PLANE, size=(4.0, 4.0, 0.1), **where)


def box_edge(spec: mujoco.MjSpec) -> None:
    """A step: right of the edge 1.8 m below the root, left of it out of reach."""
    place = {"pos": (2.5, -1.0, -0.8), "size": (2.0, 1.0, 1.0)}
    spec.worldbody.add_geom(type=GEOM.mjGEOM_BOX, **place)


def height_field(spec: mujoco.MjSpec) -> None:
    """Waves 0.25 m high in cells of half a metre, up to 2.05 m below the root."""
    x, y = np.meshgrid(np.linspace(-4.0, 4.0, 17), np.linspace(-2.0, 2.0, 9))
    waves = np.sin(1.7 * x + 0.4) * np.cos(1.1 * y) + 0.5 * np.sin(2.9 * x - 1.3 * y)
    _add_field(spec, waves, base=-0.3)


def flat_field(spec: mujoco.MjSpec) -> None:
    """The level plane 2 m below the root, as a height field of the same cells."""
    _add_field(spec, np.zeros((9, 17)), base=0.0)


def _add_field(spec: mujoco.MjSpec, heights: np.ndarray, base: float) -> None:
    rows, columns = heights.shape
    size = (4.0, 2.0, 0.25, 0.5)  # m: half x, half y, height of the highest, depth
    spec.add_hfield(
        name="field", nrow=rows, ncol=columns, size=size, userdata=heights.reshape(-1)
    )
    where = {"hfieldname": "field", "pos": (0.0, -1.0, base)}
    spec.worldbody.add_geom(type=GEOM.mjGEOM_HFIELD, **where)


UNSEEN_TERRAIN = EvaluationProtocol(
    {
        ground.__name__.replace("_", " "): DoublePendulumOver(ground)
        for ground in (two_planes, box_edge, height_field, flat_field)
    },
    (100,),
)
"""Four grounds, 100 passive steps; the paper has none of them."""


def main(options: Options) -> None:
    """Print a table for each ground and write the results."""
    measured = Eval(
        "double_pendulum", num_trajectories=options.num_trajectories, seed=options.seed
    )
    scene, rows = load_scene("double_pendulum"), []
    candidates = [*simulators(scene), *models(scene)]
    for part in measured.measure(UNSEEN_TERRAIN, candidates):
        print(f"\n{part[0].case}, {part[0].steps} steps\n{error_table(part)}")
        rows += [asdict(row) for row in part]
    if options.json is not None:
        write_results(options.json, rows, options.seed)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
