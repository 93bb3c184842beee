"""The network in float64 and bfloat16 against float32."""

import copy

from torch import Generator, bfloat16, float32, float64

from torchrl_nerd.dynamics import NeRDDynamics
from torchrl_nerd.evaluation.rollout_error import position_errors
from torchrl_nerd.evaluation.stability.case import Case, Figures
from torchrl_nerd.evaluation.stability.states import starts
from torchrl_nerd.evaluation.stability.world import DynamicsWorld, World
from torchrl_nerd.keys import QPOS

ROWS, STEPS = 32, 100
SINGLE, HALF = "float32 against float64 after 1 step", "bfloat16 after 1 step"


def _run(world: World, generator: Generator, scale: float) -> Figures:
    learned = world.dynamics
    if not isinstance(learned, NeRDDynamics):
        return {SINGLE: 0.0, HALF: 0.0}  # MuJoCo knows one precision
    start, paths = starts(world.scene, ROWS, generator), {}
    for dtype in (float64, float32, bfloat16):
        model = copy.deepcopy(learned.model)
        model.network.to(dtype)
        paths[dtype] = DynamicsWorld(NeRDDynamics(model)).roll(start, STEPS)[QPOS]
    figures = {}
    for dtype, name in ((float32, SINGLE), (bfloat16, HALF)):
        errors = position_errors(world.scene, paths[float64], paths[dtype])
        figures[name] = max(float(e[:, 1].mean()) for e in errors.values())
        later = name.replace("1 step", "100 steps")
        figures[later] = max(float(e[:, -1].mean()) for e in errors.values())
    return figures


CASE = Case(
    "precision",
    "float32 is enough for the network; what bfloat16 costs is said",
    _run,
    lines={SINGLE: 1e-5},
    needs_dynamics=True,
)
