"""Energy of an undamped robot with a fixed base that touches nothing."""

import torch
from tensordict import TensorDict
from torch import Generator, Tensor

from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.evaluation.stability.case import Case, Figures
from torchrl_nerd.evaluation.stability.measures import largest
from torchrl_nerd.evaluation.stability.states import clear_of_ground, starts
from torchrl_nerd.evaluation.stability.world import DynamicsWorld, World
from torchrl_nerd.evaluation.traces import energy
from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.scenes import Scene

ROWS, STEPS, EVERY = 16, 10_000, 50
EARLY = 1_000
DRIFT = "energy drift over 1,000 steps, share of the well's depth"
LATE = "the same over 10,000 steps"
FINE = "over 1,000 steps by RK4, four times as fine"


def _applies(scene: Scene) -> bool:
    model = scene.model
    loses = model.dof_damping.any() or model.dof_frictionloss.any()
    hangs = model.opt.gravity.any()
    return bool(hangs and not (scene.base.is_floating or loses))


def _run(world: World, generator: Generator, scale: float) -> Figures:
    scene = world.scene
    start = clear_of_ground(scene, starts(scene, ROWS, generator))
    start[QVEL] = 0.0 * start[QVEL]  # or a cart would roll off to the end of its rail
    steps = max(EVERY, round(scale * STEPS))
    path = world.roll(start, steps, every=EVERY)
    drift = _drift(scene, path)
    early = drift[:, : 1 + EARLY // EVERY]
    figures = {
        DRIFT: largest(early.mean(0)),
        "worst row": largest(early),
        LATE: largest(drift.mean(0)),
    }
    if world.is_true:  # the scene's own integrator may not keep it: physics does
        fine = DynamicsWorld(MujocoDynamics(scene.reference))
        path = fine.roll(start, min(steps, EARLY), every=EVERY)
        figures[FINE] = largest(_drift(scene, path).mean(0))
    return figures


def _drift(scene: Scene, path: TensorDict) -> Tensor:
    """Energy off its start, in depths of the well, ``(rows, steps)``."""
    qpos, qvel = (path[key].flatten(0, 1) for key in (QPOS, QVEL))
    joules = energy(scene, qpos, qvel).reshape(path.batch_size)
    well = joules[:, 0].max() - _lowest(scene)
    return (joules - joules[:, :1]).abs() / well


def _lowest(scene: Scene) -> float:
    """Potential energy of the robot hanging down, as far as random poses find it."""
    poses = clear_of_ground(scene, starts(scene, 512, Generator().manual_seed(0)))
    still = torch.zeros_like(poses[QVEL])
    return float(energy(scene, poses[QPOS], still).min())


CASE = Case(
    "energy",
    "nothing rubs and nothing drives: kinetic plus potential energy stays as it is, as "
    "far as the integrator that was learned from keeps it",
    _run,
    _applies,
    true_lines={FINE: 0.005},
    lines={DRIFT: 0.005},
)
