"""Ten thousand steps of lying still."""

import torch
from torch import Generator

from torchrl_nerd.evaluation.rollout_error import position_errors
from torchrl_nerd.evaluation.stability.case import Case, Figures, has_floating_base
from torchrl_nerd.evaluation.stability.measures import largest, mechanics
from torchrl_nerd.evaluation.stability.states import settled
from torchrl_nerd.evaluation.stability.world import World
from torchrl_nerd.keys import QPOS

ROWS, STEPS, KEPT = 16, 10_000, 100
MOVES, TURNS = "drifts, mm/s", "turns, mrad/s"
SINKS = "sinks in, m"


def _run(world: World, generator: Generator, scale: float) -> Figures:
    scene = world.scene
    start = settled(scene, ROWS)
    steps = max(KEPT, round(scale * STEPS))
    path = world.roll(start, steps, every=steps // KEPT)
    here = path[QPOS]
    errors = position_errors(scene, here[:, :1].expand_as(here), here)
    seconds = scene.control_step * steps
    depth = torch.from_numpy(mechanics(scene, path.flatten())["depth"])
    return {
        MOVES: 1e3 * largest(errors["base_position"][:, -1]) / seconds,
        TURNS: 1e3 * largest(errors["base_orientation"][:, -1]) / seconds,
        SINKS: largest(depth),
        "farthest from the start on the way, m": largest(errors["base_position"]),
    }


CASE = Case(
    "resting",
    "put down where MuJoCo came to rest it stays there, on the ground and not in it",
    _run,
    has_floating_base,
    true_lines={MOVES: 1.0, TURNS: 1.0, SINKS: 0.02},
    lines={MOVES: 1.0, TURNS: 1.0, SINKS: 0.02},
)
