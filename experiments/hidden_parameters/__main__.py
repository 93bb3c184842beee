"""Error of a model's next steps against the length of the history that it has seen.

    python -m experiments.hidden_parameters cartpole --models transformer \
        runs/cartpole_adaptive/last mlp runs/varied_mlp/last told runs/varied_told/last \
        --json results/hidden_parameters_cartpole.json

All predict the same motion from the same state, under the recorded commands. Before it
they have seen its last steps, none to a hundred. Beside the models: MuJoCo with nominal
parameters (the middle of each range), and with parameters fitted to the same history, by
the package and, with `--sysid`, by `mujoco.sysid`, which is slow: after 20 steps alone.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, cast

import torch
import tyro
from tensordict import TensorDict, TensorDictBase
from torch import Generator, Tensor

from torchrl_nerd.checkpoint import load_checkpoint
from torchrl_nerd.dynamics import MujocoDynamics, NeRDDynamics
from torchrl_nerd.dynamics.base import warm_up
from torchrl_nerd.evaluation.position_error import position_errors
from torchrl_nerd.evaluation.results import write_results
from torchrl_nerd.evaluation.rollout_error import interval_of_mean
from torchrl_nerd.keys import NEXT_QPOS, PARAMETERS, QPOS, QVEL, TERRAIN
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.robots import load_scene, preset_of
from torchrl_nerd.scenes import Scene
from torchrl_nerd.scenes.commands import command_of, drive

from .adaptation import changes, probe, rates
from .identify import identify, identify_by_mujoco
from .motions import Region, draw_parameters, motions

HISTORIES = (0, 1, 2, 5, 10, 20, 50, 100)  # steps
HORIZONS = (1, 20, 100)  # steps
REGIONS: tuple[Region, ...] = ("inside", "corners", "outside")
PAST = max(HISTORIES)
SYSID, SEEN_BY_SYSID = "mujoco.sysid", (20,)  # steps

Candidate = Callable[[TensorDict, TensorDict], Tensor]
"""``(history [rows, T], future [rows, K]) -> qpos (rows, K, nq)`` in open loop."""
Fit = Callable[[Scene, TensorDict], Tensor]
"""``(scene, history [rows, T]) -> parameters (rows, size)``."""


@dataclass
class Options:
    """What to measure."""

    scene: tyro.conf.Positional[str]
    models: dict[str, Path]
    """Checkpoint folders by name."""
    num_trajectories: int = 256
    """Per region."""
    seed: int = 900
    """Of motions and parameters; no training uses it."""
    fit: Annotated[bool, tyro.conf.arg(help="also fit MuJoCo to each history")] = True
    sysid: Annotated[bool, tyro.conf.arg(help="and by mujoco.sysid")] = False
    json: Path | None = None
    """Write the results to this file."""


def roll(dynamics: Any, scene: Scene, future: TensorDict, own: Tensor) -> Tensor:
    """Positions ``(rows, K, nq)`` under the recorded commands; ``own``: parameters."""
    first, path = cast(TensorDict, future[:, 0]), []
    state: TensorDictBase = first.select(QPOS, QVEL).set(PARAMETERS, own)
    terrain, commands = first.get(TERRAIN, None), command_of(scene, future)
    for command in commands.unbind(1):
        torque, ctrl = drive(scene, command, state[QPOS], state[QVEL])
        state = dynamics.step(state, torque, terrain, ctrl)
        path.append(state[QPOS])
    return torch.stack(path, 1)


def of_model(
    model: NeRD, scene: Scene, history: TensorDict, future: TensorDict
) -> Tensor:
    """A model that has seen the history."""
    dynamics, first = NeRDDynamics(model), cast(TensorDict, future[:, 0])
    dynamics.reset(first)
    if history.batch_size[1]:
        warm_up(dynamics, history, len(history))
    return roll(dynamics, scene, future, first[PARAMETERS])


def of_mujoco(
    scene: Scene,
    parameters: Callable[[TensorDict, TensorDict], Tensor],
    history: TensorDict,
    future: TensorDict,
) -> Tensor:
    """MuJoCo with parameters that may follow from the history."""
    dynamics = MujocoDynamics(scene, num_threads=1)
    dynamics.reset(cast(TensorDict, future[:, 0]))
    return roll(dynamics, scene, future, parameters(history, future))


def nominal(scene: Scene, history: TensorDict, future: TensorDict) -> Tensor:
    """The middle of every range."""
    assert scene.variation is not None
    u = torch.full((len(future), scene.variation.size), 0.5, dtype=torch.float64)
    return scene.variation.values(u)


def fitted(scene: Scene, fit: Fit, history: TensorDict, future: TensorDict) -> Tensor:
    """Least squares; without a history nominal."""
    if not history.batch_size[1]:
        return nominal(scene, history, future)
    return fit(scene, history)


def errors_of(scene: Scene, path: Tensor, future: TensorDict) -> dict[str, Any]:
    """Mean error and interval by horizon and quantity; median as well."""
    errors = position_errors(scene, future[NEXT_QPOS], path)
    found: dict[str, Any] = {}
    for horizon in HORIZONS:
        for quantity, error in errors.items():
            mean = error[:, :horizon].mean(1)  # (rows,)
            found.setdefault(str(horizon), {})[quantity] = {
                "mean": float(mean.mean()),
                "interval": interval_of_mean(mean),
                "median": float(mean.median()),
            }
    return found


def measure(
    scene: Scene, candidates: dict[str, Candidate], options: Options
) -> list[dict[str, Any]]:
    """A row per region, candidate and length of the history."""
    rows = []
    for number, region in enumerate(REGIONS):
        generator = Generator().manual_seed(options.seed + number)
        own = draw_parameters(scene, region, options.num_trajectories, generator)
        data = motions(scene, [own], [PAST + max(HORIZONS)], generator)
        future = cast(TensorDict, data[:, PAST:])
        for name, candidate in candidates.items():
            lengths = SEEN_BY_SYSID if name == SYSID else HISTORIES
            for length in lengths:
                history = cast(TensorDict, data[:, PAST - length : PAST])
                began = time.perf_counter()
                path = candidate(history, future)
                seconds = (time.perf_counter() - began) / len(data)
                row = {"region": region, "name": name, "history": length}
                row |= {"seconds": seconds, "errors": errors_of(scene, path, future)}
                rows.append(row)
            shown = {r["history"]: r["errors"]["100"] for r in rows[-len(lengths) :]}
            brief = (_brief(shown[n]) for n in (0, 20, 100) if n in shown)
            print(region, name, *brief, flush=True)
    return rows


def _brief(errors: dict[str, Any]) -> str:
    return ", ".join(f"{k} {v['mean']:.3g}" for k, v in errors.items())


def main(options: Options) -> None:
    """Measure all and write the results."""
    preset = preset_of(options.scene)
    scene = load_scene(options.scene).vary(preset.variation)
    models = {
        k: cast(NeRD, load_checkpoint(v, scene)) for k, v in options.models.items()
    }
    candidates: dict[str, Candidate] = {
        "MuJoCo, nominal": partial(of_mujoco, scene, partial(nominal, scene)),
        **{name: partial(of_model, model, scene) for name, model in models.items()},
    }
    if options.fit:
        fit = partial(fitted, scene, identify)
        candidates["MuJoCo, fitted"] = partial(of_mujoco, scene, fit)
    if options.sysid:
        fit = partial(fitted, scene, identify_by_mujoco)
        candidates[SYSID] = partial(of_mujoco, scene, fit)
    results: dict[str, Any] = {
        "scene": scene.name,
        "variation": preset.variation,
        "num_trajectories": options.num_trajectories,
        "errors": measure(scene, candidates, options),
        "changes": changes(scene, models, options.seed + 10),
        "probe": probe(scene, models, options.seed + 20),
        "rates": rates(load_scene(options.scene), models),
    }
    if options.json is not None:
        write_results(options.json, results, options.seed)


if __name__ == "__main__":
    torch.set_num_threads(1)
    with torch.no_grad():
        main(tyro.cli(Options))
