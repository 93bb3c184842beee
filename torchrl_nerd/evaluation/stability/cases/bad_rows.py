"""One row in 4,096 that is no number, infinite, enormous or denormal."""

import torch
from torch import Generator

from torchrl_nerd.evaluation.stability.case import Case, Figures
from torchrl_nerd.evaluation.stability.states import starts, uniform_torque
from torchrl_nerd.evaluation.stability.world import World
from torchrl_nerd.keys import QPOS, QVEL

ROWS, STEPS = 4096, 3
JUNK = (float("nan"), float("inf"), -float("inf"), 1e200, 5e-324)
CHANGED = "numbers changed in other rows"


def _run(world: World, generator: Generator, scale: float) -> Figures:
    scene, rows = world.scene, max(8, round(scale * ROWS))
    start = starts(scene, rows, generator)
    torque = uniform_torque(scene, rows, STEPS, generator)
    expected = world.roll(start, STEPS, torque)
    changed = 0
    for junk in JUNK:
        row = int(torch.randint(rows, (), generator=generator))
        others = torch.arange(rows) != row
        # an env refuses such a state in one sentence
        for key in ("torque",) if world.dynamics is None else (QPOS, QVEL, "torque"):
            bad, drive = start.clone(), torque.clone()
            (drive if key == "torque" else bad[key])[row] = junk
            got = world.roll(bad, STEPS, drive)
            for name in (QPOS, QVEL):
                same = got[name][others] == expected[name][others]
                changed += int((~same).sum())
    return {CHANGED: float(changed)}


CASE = Case(
    "bad_rows",
    "what is broken in one row changes not a bit in any other",
    _run,
    true_lines={CHANGED: 0.0},
    lines={CHANGED: 0.0},
)
