"""No torque, all of it, a thousand times that, and from one end to the other."""

import torch
from torch import Generator

from torchrl_nerd.evaluation.stability.case import Case, Figures, has_motors
from torchrl_nerd.evaluation.stability.measures import largest
from torchrl_nerd.evaluation.stability.states import extreme_torques, starts
from torchrl_nerd.evaluation.stability.world import World
from torchrl_nerd.keys import QPOS, QVEL

ROWS, STEPS = 4, 1000
SPEED = "largest speed, m/s or rad/s"
BROKEN = "rows that are no numbers"


def _run(world: World, generator: Generator, scale: float) -> Figures:
    scene = world.scene
    figures, fastest, broken = {}, 0.0, 0
    steps = max(20, round(scale * STEPS))
    for name, torque in extreme_torques(scene, ROWS, 2).items():
        path = world.roll(starts(scene, ROWS, generator), steps, torque, steps // 20)
        state = torch.cat((path[QPOS], path[QVEL]), -1)
        broken += int((~state.isfinite()).flatten(1).any(1).sum())
        speed = float(path[QVEL].abs().nan_to_num(0.0, 0.0, 0.0).amax())
        figures[f"largest speed, {name}"] = speed
        fastest = max(fastest, speed)
    return {BROKEN: float(broken), SPEED: largest(torch.tensor(fastest)), **figures}


CASE = Case(
    "torques",
    "whatever the motors are told, a learned state stays a state; MuJoCo itself gives up "
    "on some rows",
    _run,
    has_motors,
    lines={BROKEN: 0.0, SPEED: 1e3},
)
