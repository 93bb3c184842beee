"""Draw the error of a model over time, and the energy of one trajectory beside MuJoCo's.

    python examples/traces.py double_pendulum --case "terrain 3"
    python examples/traces.py ant --dynamics ant-mlp --out ant.png

Both start in the same states and get the same actions. Errors are the mean and the 5% to
95% band over all trajectories. Energy and distance to the terrain are of the trajectory
whose error is the median.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import cast

import torch
import tyro
from matplotlib.figure import Figure
from tensordict import TensorDict

from torchrl_nerd.checkpoint import from_pretrained
from torchrl_nerd.dynamics import MujocoDynamics, dynamics_of
from torchrl_nerd.evaluation.position_error import position_errors, unit_of
from torchrl_nerd.evaluation.rollout_error import (
    action_drive,
    initial_states,
    rollout,
    scene_of,
)
from torchrl_nerd.evaluation.stability.states import mechanics
from torchrl_nerd.robots import load_scene, protocol_of
from torchrl_nerd.settings import look_up


@dataclass(frozen=True)
class Options:
    """What to roll out, and where the figure goes."""

    scene: tyro.conf.Positional[str] = "cartpole"  # name of the robot
    dynamics: str = "nerd"  # nerd, hybrid, analytic, a shipped model or a folder
    case: str = ""  # of the robot's evaluation protocol; its first by default
    trajectories: int = 64
    steps: int = 0  # control steps; the protocol's shortest horizon by default
    seed: int = 500  # of the initial states
    out: Path = Path("traces.png")


def main(options: Options) -> None:
    """Roll out both, print the final errors, draw."""
    own = load_scene(options.scene)
    protocol = protocol_of(own)
    case = options.case or next(iter(protocol.cases))
    source = look_up("case", case, protocol.cases)
    count, steps = options.trajectories, options.steps or min(protocol.horizons)

    scene, model = scene_of(source), from_pretrained(options.dynamics, own)
    model = model if scene is own else model.with_terrain(scene)
    start = initial_states(source, count, options.seed)
    is_random = case in protocol.random_actions
    drive = action_drive(source, count, steps, options.seed, is_random)
    paths = {
        "MuJoCo": rollout(MujocoDynamics(scene), start, steps, drive),
        options.dynamics: rollout(dynamics_of(model), start, steps, drive),
    }
    errors = position_errors(scene, *(path["qpos"] for path in paths.values()))
    seconds = scene.control_step * torch.arange(steps + 1)

    relative = [e.mean(1) / e.mean().clamp_min(1e-12) for e in errors.values()]
    median = int(torch.stack(relative).mean(0).argsort()[count // 2])
    # [steps + 1] each
    shown = {name: cast(TensorDict, path[median]) for name, path in paths.items()}
    traces = {
        "energy (J)": {k: mechanics(scene, p)["energy"] for k, p in shown.items()}
    }
    if scene.terrain is not None:
        ground = start.get("terrain", None)
        ground = None if ground is None else ground[median].expand(steps + 1, -1)
        traces["distance to the terrain (m)"] = {
            k: scene.clearances(p["qpos"], ground).amin(-1) for k, p in shown.items()
        }

    units = sorted({unit_of(scene, quantity) for quantity in errors})
    panels = len(units) + len(traces)
    figure = Figure(figsize=(7.0, 2.2 * panels), layout="constrained")
    axes = figure.subplots(panels, 1, sharex=True)
    for name, error in errors.items():
        unit = unit_of(scene, name)
        panel = axes[units.index(unit)]
        panel.plot(seconds, error.mean(0), label=name)
        low, high = error.quantile(0.05, 0), error.quantile(0.95, 0)
        panel.fill_between(seconds, low, high, alpha=0.15)
        panel.set_ylabel(f"error ({unit})")
        print(f"{name}: {error[:, -1].mean():.3g} {unit} after {steps} steps")
    for panel, (label, lines) in zip(axes[len(units) :], traces.items(), strict=True):
        for (name, line), style in zip(lines.items(), ("-", "--"), strict=True):
            panel.plot(seconds, line, style, label=name)
        panel.set_ylabel(label)
    for panel in axes:
        panel.legend(frameon=False, fontsize=8)
    axes[-1].set_xlabel("time (s)")
    figure.suptitle(f"{options.scene}, {case}: {options.dynamics} against MuJoCo")
    figure.savefig(options.out, dpi=150)
    print(f"{options.out}: {count} trajectories, {case}")


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
