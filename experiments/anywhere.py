"""Whether a model is equally accurate far from the origin and whichever way it faces.

    python experiments/anywhere.py ant

The starts of the scene's protocol, and the same ones turned about the vertical and moved
level, each in learned and in MuJoCo; prints the largest relative difference of the
two error curves (mean over rows, step by step).
"""

import math
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from tensordict import TensorDict
from torch import Tensor
from tyro.conf import Positional

from torchrl_nerd.checkpoint import from_pretrained
from torchrl_nerd.dynamics import Dynamics, MujocoDynamics, dynamics_of
from torchrl_nerd.evaluation.position_error import position_errors
from torchrl_nerd.evaluation.results import write_results
from torchrl_nerd.evaluation.rollout_error import (
    action_drive,
    initial_states,
    open_loop,
    scene_of,
)
from torchrl_nerd.geometry.rotations import quat_multiply, rotate
from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.robots import Source, load_scene, protocol_of
from torchrl_nerd.scenes import Scene

FLOOR = 1e-6  # m and rad: no model's error is compared below it


@dataclass
class Options:
    """What to move, and where."""

    scene: Positional[str] = "ant"
    model: Path | None = None
    """Checkpoint folder; the shipped model by default."""
    double: bool = False
    """The model in float64: its springs are in float32 like its network."""
    distance: float = 10_000.0
    """m, level, in a random direction."""
    rows: int = 256
    seed: int = 500
    json: Path | None = None
    """Write the results to this file."""


def moved(scene: Scene, start: TensorDict, yaw: float, shift: Tensor) -> TensorDict:
    """States of a floating robot turned about the vertical (rad) and shifted (m)."""
    if not scene.base.is_floating:
        raise ValueError(f"expected a floating base, '{scene.name}' is fixed")
    q, v = scene.base.qpos_address, scene.base.dof_address
    turn = torch.tensor([math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)]).double()
    start = start.clone()
    qpos, qvel = start[QPOS], start[QVEL]
    qpos[:, q : q + 3] = rotate(turn, qpos[:, q : q + 3]) + shift
    qpos[:, q + 3 : q + 7] = quat_multiply(turn, qpos[:, q + 3 : q + 7])
    qvel[:, v : v + 3] = rotate(turn, qvel[:, v : v + 3])
    return start


def error_curves(
    source: Source, learned: Dynamics, start: TensorDict, steps: int, random: bool
) -> dict[str, Tensor]:
    """Mean error over rows at every step, ``(steps,)``."""
    scene = scene_of(source)
    drive = action_drive(source, len(start), steps, 0, random)
    both = MujocoDynamics(scene), learned
    errors = position_errors(scene, *(open_loop(d, start, steps, drive) for d in both))
    return {name: error.mean(0) for name, error in errors.items()}


def main(options: Options) -> dict[str, float]:
    """Print a line for each quantity."""
    protocol = protocol_of(load_scene(options.scene))
    case, source = next(iter(protocol.cases.items()))
    scene, steps = scene_of(source), max(protocol.horizons)
    model = from_pretrained(options.model or options.scene, scene)
    learned = dynamics_of(model.double() if options.double else model)
    generator = torch.Generator().manual_seed(options.seed)
    yaw, way = (2.0 * math.pi * torch.rand(2, generator=generator)).tolist()
    shift = torch.tensor([math.cos(way), math.sin(way), 0.0]).double()
    start = initial_states(source, options.rows, options.seed)
    there = moved(scene, start, yaw, options.distance * shift)
    random = case in protocol.random_actions
    curves = [error_curves(source, learned, x, steps, random) for x in (start, there)]
    results = {}
    for name, here in curves[0].items():
        apart = (curves[1][name] - here).abs() / here.clamp_min(FLOOR)
        results[name] = float(apart.max())
        print(f"{name:<18}{steps} steps: {results[name]:.1e} relative")
    if options.json is not None:
        found = {"scene": scene.name, "relative": results}
        write_results(options.json, found, options.seed)
    return results


if __name__ == "__main__":
    main(tyro.cli(Options))
