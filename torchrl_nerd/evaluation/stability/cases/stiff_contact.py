"""Ground stiffer than the one that was learned."""

import copy
from dataclasses import replace

from torch import Generator

from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.evaluation.stability.case import Case, Figures
from torchrl_nerd.evaluation.stability.measures import apart, largest
from torchrl_nerd.evaluation.stability.states import starts
from torchrl_nerd.evaluation.stability.world import DynamicsWorld, World
from torchrl_nerd.keys import QPOS
from torchrl_nerd.scenes import Scene

ROWS, STEPS, STIFFER = 32, 60, 4.0
FARTHEST = "largest error against the stiffer ground, m or rad"


def stiffer(scene: Scene, factor: float) -> Scene:
    """The same scene with contacts that many times as stiff, as strongly damped.

    MuJoCo's stiffness goes with the inverse square of a contact's time constant, which it
    keeps at two timesteps or more.
    """
    model = copy.copy(scene.model)
    is_time = model.geom_solref[:, 0] > 0.0  # else stiffness and damping themselves
    model.geom_solref[is_time, 0] /= factor**0.5
    model.geom_solref[~is_time, 0] *= factor
    model.geom_solref[~is_time, 1] *= factor**0.5
    return replace(scene, model=model)


def _run(world: World, generator: Generator, scale: float) -> Figures:
    scene = world.scene
    start = starts(scene, ROWS, generator)
    worlds = [
        DynamicsWorld(MujocoDynamics(s)) for s in (scene, stiffer(scene, STIFFER))
    ]
    mine, plain, stiff = (w.roll(start, STEPS)[QPOS] for w in (world, *worlds))
    changed = apart(scene, plain, stiff)
    error = apart(scene, stiff, mine)
    return {
        "mean error against the stiffer ground, m or rad": float(error.mean()),
        "against its own ground": float(apart(scene, plain, mine).mean()),
        "what the stiffness changes in MuJoCo": float(changed.mean()),
        FARTHEST: largest(error),
    }


CASE = Case(
    "stiff_contact",
    "a model cannot know a ground four times as stiff; it must not break on the way",
    _run,
    lambda scene: scene.terrain is not None,
    true_lines={FARTHEST: 1e3},
    lines={FARTHEST: 1e3},
)
