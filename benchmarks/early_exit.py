"""How many rows could be spared a whole step, in flight or at rest: an upper bound.

    python benchmarks/early_exit.py

Along true motion from the starts of each scene's protocol. A row flies where no contact
point is within a millimetre of the ground and no joint beyond a limit, when a step begins
and when it ends: it needs no springs. A row rests where nothing in it moves faster than 1
mm/s or 1 mrad/s at either end: it needs no step at all. The bound is the rate if such rows
took no time, in the present one.
"""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
import tyro
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.evaluation.rollout_error import action_drive, initial_states, scene_of
from torchrl_nerd.files import write_json
from torchrl_nerd.keys import QPOS, QVEL, TERRAIN
from torchrl_nerd.modules.flight import LEAST_GAP
from torchrl_nerd.analytic.unconstrained import UnconstrainedStep
from torchrl_nerd.robots import Source, load_scene, protocol_of
from torchrl_nerd.scenes import Scene

SLOW = 1e-3  # m/s or rad/s


@dataclass
class Options:
    """Whose rows to count."""

    scenes: tuple[str, ...] = ("double_pendulum", "cube", "cube_slope", "ant", "anymal")
    rows: int = 64
    """Of each case."""
    seed: int = 500
    json: Path | None = None
    """Write the shares to this file."""


@dataclass(frozen=True)
class Shares:
    """Of all steps of all rows.

    | field | meaning |
    |---|---|
    | ``drive`` | passive, or random actions through the task's controller |
    | ``flying``, ``resting`` | shares, 0 to 1; a row that rests does not fly |
    """

    scene: str
    drive: str
    steps: int
    flying: float
    resting: float

    @property
    def bound(self) -> float:
        """Rate in the present one, if such rows took no time."""
        return 1.0 / max(1.0 - self.flying - self.resting, 1e-9)


def shares(name: str, options: Options) -> Iterator[Shares]:
    """Of one scene: passive, then driven, if it has motors."""
    protocol = protocol_of(load_scene(name))
    cases, steps = list(protocol.cases.values()), max(protocol.horizons)
    drives = ["passive", "random actions"]
    for drive in drives[: 1 + bool(scene_of(cases[0]).actuated)]:
        found = [
            _of_case(source, steps, drive == drives[1], options) for source in cases
        ]
        flying, resting = torch.tensor(found).mean(0).tolist()
        yield Shares(name, drive, steps, flying, resting)


def _of_case(
    source: Source, steps: int, has_actions: bool, options: Options
) -> tuple[float, ...]:
    scene, rows = scene_of(source), options.rows
    start = initial_states(source, rows, options.seed)
    torque = action_drive(source, rows, steps, options.seed, has_actions)
    terrain = start.get(TERRAIN, None)
    state: TensorDictBase = start.select(QPOS, QVEL)
    dynamics, free_step = MujocoDynamics(scene), UnconstrainedStep(scene)
    before, counts = None, torch.zeros(2, dtype=torch.float64)
    for step in range(steps + 1):
        now = kinds(free_step, scene, state, terrain)
        if before is not None:
            flies, rests = (x & y for x, y in zip(before, now, strict=True))
            flies = flies & ~rests
            counts += torch.stack((flies.double().mean(), rests.double().mean()))
        before = now
        if step < steps:
            state = dynamics.step(state, torque(step, state), terrain)
    return tuple((counts / steps).tolist())


def kinds(
    free_step: UnconstrainedStep, scene: Scene, state: TensorDictBase, terrain: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Which rows are clear of everything, and which are slow, ``(rows,)``."""
    gap = scene.clearances(state[QPOS], terrain)
    is_clear = (gap > LEAST_GAP).all(-1) & free_step.is_within(state[QPOS])
    is_slow: Tensor = state[QVEL].abs().amax(-1) < SLOW
    return is_clear, is_slow


def main(options: Options) -> list[Shares]:
    """Print a row for each scene and drive."""
    print(f"| scene | steps | in flight | at rest | rate, at most |\n{'|---' * 5}|")
    found = []
    for name in options.scenes:
        for x in shares(name, options):
            cells = f"{x.flying:.1%} | {x.resting:.1%} | {x.bound:.2f}"
            print(f"| {name}, {x.drive} | {x.steps} | {cells} |", flush=True)
            found.append(x)
    if options.json is not None:
        about = {"rows": options.rows, "seed": options.seed}
        write_json(options.json, {**about, "shares": [asdict(x) for x in found]})
    return found


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
