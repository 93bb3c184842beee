"""A block on a slope, a little less and a little more steep than friction holds."""

import math

import mujoco
import torch
from torch import Generator, Tensor

from torchrl_nerd.dynamics import MujocoDynamics, NeRDDynamics
from torchrl_nerd.evaluation.stability.case import Case, Figures
from torchrl_nerd.evaluation.stability.measures import largest, length
from torchrl_nerd.evaluation.stability.states import (
    ground_turned,
    settled,
    turned,
)
from torchrl_nerd.evaluation.stability.world import DynamicsWorld, World
from torchrl_nerd.keys import QVEL
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.contact_points import ground_geoms
from torchrl_nerd.scenes.terrain import PLANE

ROWS, SECONDS = 16, 1.0
SHARES = {"less": 0.95, "more": 1.05}
SLIDES = {
    name: f"speed after 1 s on a slope of tan = {share} mu, off Coulomb's, m/s"
    for name, share in SHARES.items()
}


def _friction(scene: Scene) -> float:
    """Of the block on the ground, as MuJoCo takes it from the two."""
    model, ground = scene.model, ground_geoms(scene.model)[0]
    block = (model.geom_bodyid > 0).nonzero()[0][0]
    first, second = model.geom_priority[[ground, block]]
    mine = model.geom_friction[[ground, block], 0]
    return float(mine.max() if first == second else mine[int(second > first)])


def _applies(scene: Scene) -> bool:
    """One free block over one plane, on which it slides sooner than it topples."""
    free = int(mujoco.mjtJoint.mjJNT_FREE)
    is_block = scene.model.njnt == 1 and scene.model.jnt_type[0] == free
    kinds = [] if scene.terrain is None else [s.kind for s in scene.terrain.surfaces]
    return bool(is_block and kinds == [PLANE] and _friction(scene) < 0.5)


def _run(world: World, generator: Generator, scale: float) -> Figures:
    scene, start = world.scene, settled(world.scene, ROWS)
    gravity = float(torch.from_numpy(scene.model.opt.gravity.copy()).norm())
    friction, figures = _friction(scene), {}
    for name, share in SHARES.items():
        angle = math.atan(share * friction)
        turn = torch.tensor([math.cos(angle / 2.0), 0.0, math.sin(angle / 2.0), 0.0])
        turn = turn.double()
        expected = gravity * (math.sin(angle) - friction * math.cos(angle)) * SECONDS
        try:
            there = _on_slope(world, turn)
        except ValueError:  # learned on level ground, whose normal is no feature
            figures[SLIDES[name]] = math.nan
            continue
        steps = round(SECONDS / scene.control_step)
        end = there.roll(turned(scene, start, turn), steps)[QVEL][:, -1]
        figures[SLIDES[name]] = largest((length(end[:, :3]) - max(expected, 0.0)).abs())
    return figures


def _on_slope(world: World, turn: Tensor) -> World:
    """The same dynamics over turned ground; a ground per row turns with the state.

    Raises:
        ValueError: a model that was trained over other kinds of ground.
    """
    terrain = world.scene.terrain
    if terrain is not None and terrain.is_per_row:
        return world
    slope = ground_turned(world.scene, turn)
    if isinstance(world.dynamics, NeRDDynamics):
        return DynamicsWorld(NeRDDynamics(world.dynamics.model.with_terrain(slope)))
    return DynamicsWorld(MujocoDynamics(slope))


CASE = Case(
    "slope",
    "friction holds a block up to its angle and no farther: Coulomb's law",
    _run,
    _applies,
    true_lines=dict.fromkeys(SLIDES.values(), 0.02),
    lines=dict.fromkeys(SLIDES.values(), 0.02),
    needs_dynamics=True,
)
