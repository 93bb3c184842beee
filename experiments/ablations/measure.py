"""Errors of one variant of one seed, and what it took."""

import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

from tensordict import TensorDict
from torch import Tensor

from torchrl_nerd.configs import DataConfig
from torchrl_nerd.data.generate import generate, load_data
from torchrl_nerd.data.strategies import preset_strategy
from torchrl_nerd.dynamics import Dynamics, MujocoDynamics, NeRDDynamics
from torchrl_nerd.evaluation.position_error import position_errors
from torchrl_nerd.evaluation.rollout_error import initial_states, open_loop, summarize
from torchrl_nerd.files import read_json, write_json
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.robots import protocol_of, source_of
from torchrl_nerd.scenes import Scene

from .training import VariantTrainer
from .variants import VARIANTS, Variant

STEPS = 100  # of a trajectory of the data
MOST_STEPS = 500  # of a test, as in the paper
NO_GROUND, GROUNDS = "no ground", "grounds 1 to 6"


@dataclass(frozen=True)
class Budget:
    """What every variant gets.

    | field | meaning |
    |---|---|
    | ``trajectories`` | of the data, of 100 transitions each |
    | ``updates`` | of 1,024 tokens each |
    | ``rows`` | trajectories of each of the scene's tests |
    | ``test_seed`` | of their starts |
    """

    trajectories: int
    updates: int
    rows: int
    test_seed: int


class Bed:
    """One scene's data and tests, the same for all variants.

    Args:
        scene: the robot.
        budget: how much of each.
        folder: of the data, which are drawn once, and of all results.
    """

    def __init__(self, scene: Scene, budget: Budget, folder: Path) -> None:
        self.scene, self.budget, self.folder = scene, budget, folder
        protocol = protocol_of(scene)
        config = DataConfig(budget.trajectories, STEPS)
        place = folder / f"data_{budget.trajectories}"
        draw = preset_strategy(scene)
        self.data = load_data(scene, generate(scene, config, place, strategy=draw))
        self.source = source_of(scene)
        self.steps = min(max(protocol.horizons), MOST_STEPS)
        cases = [
            initial_states(source, budget.rows, budget.test_seed)
            for source in protocol.cases.values()
        ]
        self.start = cast(TensorDict, TensorDict.cat(cases))
        self.ground_truth = self.paths(MujocoDynamics(scene))

    def paths(self, dynamics: Dynamics) -> Tensor:
        """Positions of every passive test, ``(rows, steps, nq)``."""
        return open_loop(dynamics, self.start, self.steps)

    def errors(self, dynamics: Dynamics) -> dict[str, dict[str, dict[str, Any]]]:
        """Case -> quantity -> mean, final and 95th percentile."""
        errors = position_errors(self.scene, self.ground_truth, self.paths(dynamics))
        found = {}
        for case, rows in self.cases():
            part = {name: error[rows] for name, error in errors.items()}
            summaries = summarize(self.scene, part)
            found[case] = {name: asdict(error) for name, error in summaries.items()}
        return found

    def cases(self) -> Iterator[tuple[str, slice]]:
        """The tests by name, and their rows; the pendulum's grounds are one."""
        rows, total = self.budget.rows, len(self.start)
        if total == rows:
            yield "passive", slice(None)
        else:
            yield NO_GROUND, slice(rows)
            yield GROUNDS, slice(rows, total)

    def measure(self, name: str, seed: int) -> dict[str, Any]:
        """Results of one variant, made unless they are there."""
        variant = VARIANTS[self.scene.name][name]
        folder = self.folder / f"{name.replace(' ', '_')}_{seed}"
        path, settings = folder / "results.json", asdict(self.budget)
        if path.exists() and read_json(path)["settings"] == settings:
            return read_json(path)
        began = time.process_time()
        model = self.train(variant, folder, seed)
        seconds = time.process_time() - began
        mode = {"inference": "window", "window": variant.window}
        how: dict[str, Any] = mode if variant.window else {}
        results = {
            "variant": name,
            "seed": seed,
            "what": variant.what,
            "features": model.scene_features.size,
            "outputs": model.state_delta.size,
            "weights": sum(weight.numel() for weight in model.network.parameters()),
            "seconds": round(seconds, 1),
            "errors": self.errors(NeRDDynamics(model, **how)),
            "settings": settings,
        }
        write_json(path, results)
        return read_json(path)

    def train(self, variant: Variant, folder: Path, seed: int) -> NeRD:
        """The variant with averaged weights."""
        updates = self.budget.updates
        parts = variant, self.scene, self.data, self.source, folder
        return VariantTrainer(*parts, updates, seed).run()
