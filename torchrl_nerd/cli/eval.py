"""``nerd eval``: open-loop error against MuJoCo or recorded trajectories."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

from torch import Tensor

from torchrl_nerd.checkpoint import from_pretrained
from torchrl_nerd.cli.command import MeasuringCommand
from torchrl_nerd.cli.options import (
    ModelName,
    Positional,
    SceneName,
    Vary,
    recorded_scene,
    varied_ranges,
)
from torchrl_nerd.data.log_files import load_recording
from torchrl_nerd.data.recorded import Recording
from torchrl_nerd.dynamics import Dynamics, Model, MujocoDynamics, dynamics_of
from torchrl_nerd.evaluation.bench.candidates import (
    Candidate,
    analytic_step,
    models,
    mujoco_name,
    simulators,
)
from torchrl_nerd.evaluation.bench.errors import (
    ErrorRow,
    cases_of,
    error_rows,
    evaluation_set,
    measure,
)
from torchrl_nerd.evaluation.bench.summary import summary_table, warnings
from torchrl_nerd.evaluation.recorded_error import STATES, compare, errors_as_text
from torchrl_nerd.robots import (
    EvaluationProtocol,
    RecordedProtocol,
    load_scene,
    protocol_of,
    recorded_protocol,
)
from torchrl_nerd.scenes import Scene
from torchrl_nerd.settings import expect_at_least

SIMULATED = "num_trajectories", "seed", "variants", "vary", "history", "reference"
"""Options that recorded trajectories have no use for."""


@dataclass(frozen=True)
class Eval(MeasuringCommand):
    """Open-loop error of MuJoCo at coarser settings and of every model, beside the paper.

    All start in the same states, get the same actions and are measured against the same
    ground truth: MuJoCo with the scene's own integrator and substeps, as in the paper, or
    the reference solver. Passive, and driven by random actions where there are actuators.

    Example: nerd eval cartpole --json results/eval_cartpole.json

    Example: nerd eval cartpole --vary preset --history 20

    Example: nerd eval cube --data cube_tosses.npz --split test --baselines
    """

    scene: Positional[SceneName]
    model: ModelName = None
    num_trajectories: int = 2048
    """How many trajectories of each case the errors are means of."""
    seed: int = 500
    """Of the initial states; test seeds are never used in training or validation."""
    variants: tuple[str, ...] = ()
    """Other ways to run each model: compiled, bf16 (the network in bfloat16), or window
    (a transformer that recomputes its history at every step, as in the paper)."""
    vary: Vary = ()
    history: int = 0
    """Steps of the ground truth's motion that every candidate has seen before: what a
    model adapts to."""
    reference: Literal["rk4"] | None = None
    """Measure against the reference solver in place of the scene's own: MuJoCo's RK4 at
    four times its substeps."""
    data: Path | None = None
    """Recorded trajectories (npz or CSV) in place of MuJoCo: every window of `states`."""
    split: str = "all"
    """Of recorded trajectories: all, train, validation or test."""
    states: int = STATES
    """Of a window of recorded trajectories, its start among them."""
    baselines: bool = False
    """Beside it, on recorded trajectories: MuJoCo and the analytic step with the scene's
    own parameters."""

    def inputs(self) -> tuple[Scene, dict[str, Sequence[float]]]:
        """The robot and what of it varies; bad input is refused."""
        if self.data is not None:
            for name in SIMULATED:
                if getattr(self, name) != getattr(type(self), name):
                    flag = name.replace("_", "-")
                    raise ValueError(f"expected --{flag} without --data")
            expect_at_least(2, states=self.states)
            return recorded_scene(self.scene), {}
        if self.baselines or self.split != "all" or self.states != STATES:
            raise ValueError("expected --data with --baselines, --split or --states")
        expect_at_least(2, num_trajectories=self.num_trajectories)
        expect_at_least(0, history=self.history)
        return load_scene(self.scene), varied_ranges(self.scene, self.vary)

    def models(self, scene: Scene, device: str) -> list[Candidate]:
        """Those asked for, with their variants; a name that is none is refused."""
        names = [] if self.model is None else [self.model]
        return models(scene, names, device, self.variants)

    def recorded(
        self, path: Path, scene: Scene
    ) -> tuple[RecordedProtocol, Model, Recording, Tensor]:
        """Protocol, model, log and starts of its windows; a split that is none refused."""
        protocol = recorded_protocol(self.scene)
        model = from_pretrained(self.model or protocol.model, scene).to(self.device)
        recording, split = load_recording(path, scene)
        if self.split != "all" and self.split not in split:
            expected = ", ".join(("all", *split))
            raise ValueError(f"expected split {expected}, got '{self.split}'")
        chosen = None if self.split == "all" else split[self.split]
        return protocol, model, recording, recording.starts(self.states, chosen)

    def plan(self) -> list[str]:
        """How many windows of a log would be measured; bad models are refused."""
        scene, ranges = self.inputs()
        if self.data is None:
            self.models(scene.vary(ranges) if ranges else scene, "cpu")
            return []
        *_, starts = self.recorded(self.data, scene)
        return [f"measure {len(starts)} windows of {self.states} states"]

    def run(self) -> dict[str, Any]:
        """Print the tables and return their rows; bad input raises ValueError."""
        scene, ranges = self.inputs()
        if self.data is not None:
            return self.run_recorded(self.data, scene)
        protocol = protocol_of(scene)
        if ranges:
            cases = {k: source.vary(ranges) for k, source in protocol.cases.items()}
            scene = scene.vary(ranges)
            protocol = replace(protocol, cases=cases, published={})
        learned = self.models(scene, self.device)  # refuses bad ones before any work
        solver_name = mujoco_name(self.ground_truth(scene).scene)
        solver = "the reference solver" if self.reference else "the scene's own solver"
        print(
            f"{self.scene}: {self.num_trajectories} trajectories per case. Ground truth: "
            f"{solver_name}, {solver}. "
            "Every candidate, coarse MuJoCo included, is measured against it."
        )
        candidates = simulators(scene)
        if ranges:
            print(
                f"Every trajectory is of another robot: {', '.join(ranges)}. MuJoCo "
                "knows each, but for the nominal one. So do models that are told the "
                "parameters."
            )
            candidates.append(
                Candidate(f"{solver_name}, nominal", "simulator", self.nominal)
            )
        candidates += learned
        parts = self.measure(protocol, candidates)
        rows = [row for part in parts for row in part]
        print(f"\n{summary_table(scene, rows)}\n")
        for sentence in warnings(scene, rows):
            print(sentence)
        return {
            "scene": self.scene,
            "num_trajectories": self.num_trajectories,
            "ground_truth": solver_name,
            "errors": [asdict(row) for row in rows],
        }

    def ground_truth(self, scene: Scene) -> MujocoDynamics:
        """MuJoCo with the scene's own solver or the reference solver."""
        return MujocoDynamics(scene.reference if self.reference else scene)

    def nominal(self, scene: Scene) -> MujocoDynamics:
        """The same, with the robot as its file has it, whatever varies."""
        return self.ground_truth(replace(scene, variation=None))

    def measure(
        self, protocol: EvaluationProtocol, candidates: list[Candidate]
    ) -> Iterator[list[ErrorRow]]:
        """Rows of one case and horizon after the other."""
        about = self.num_trajectories, max(protocol.horizons), self.seed, self.device
        about = *about, self.history
        for case, source, is_driven in cases_of(protocol):
            chosen = evaluation_set(case, source, is_driven, self.ground_truth, *about)
            errors = measure([chosen], candidates, f"{self.scene}: {case}", self.quiet)
            for horizon in protocol.horizons:
                published = protocol.published
                yield error_rows(chosen.scene, case, horizon, errors, published)

    def run_recorded(self, path: Path, scene: Scene) -> dict[str, Any]:
        """The same for recorded trajectories."""
        protocol, model, recording, starts = self.recorded(path, scene)
        tested: dict[str, Dynamics] = {}
        if self.baselines:
            tested["MuJoCo"] = MujocoDynamics(scene)
            if analytic_step(scene)[0]:
                tested["analytic"] = dynamics_of(from_pretrained("analytic", scene))
        tested["model"] = dynamics_of(model)
        table = compare(tested, scene, recording, starts, self.states)
        published = protocol.published if self.states == STATES else {}
        print(errors_as_text(table, published, self.states))
        shared = {"scene": scene.name, "split": self.split, "windows": len(starts)}
        return {**shared, **table["model"], "others": table}

    def content(self, results: dict[str, Any]) -> dict[str, Any]:
        """As of every measurement; of recordings, each result at the top as well."""
        record = super().content(results)
        if self.data is None:
            return record
        record["seed"] = None  # nothing is drawn
        return {"configuration": self.configuration(), **results, **record}
