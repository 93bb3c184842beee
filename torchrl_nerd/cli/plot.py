"""``nerd plot``: figures of a model's rollouts, or of a training run."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchrl_nerd.checkpoint import from_pretrained
from torchrl_nerd.cli.command import DeviceCommand
from torchrl_nerd.cli.options import Positional
from torchrl_nerd.dynamics import MujocoDynamics, dynamics_of
from torchrl_nerd.evaluation.rollout_error import scene_of
from torchrl_nerd.evaluation.trace_plot import plot_traces, plot_training
from torchrl_nerd.evaluation.traces import Traces, compare_traces
from torchrl_nerd.files import folder_name
from torchrl_nerd.robots import load_scene, protocol_of
from torchrl_nerd.settings import expect_at_least


@dataclass(frozen=True)
class Plot(DeviceCommand):
    """Error, energy and distance to the ground over time; or the curves of a training run.

    Example: nerd plot double_pendulum --case "ground 3" --out rollouts.png

    Example: nerd plot runs/cartpole
    """

    what: Positional[str]
    """Name of a robot, as for eval; or the folder of a run, which holds a log.csv."""
    model: Path | None = None
    """Checkpoint folder; the shipped model by default."""
    case: str | None = None
    """Of the robot's protocol, as eval names them; the first by default."""
    rows: int = 64
    """Trajectories."""
    steps: int | None = None
    """Control steps; the protocol's shortest horizon by default."""
    seed: int = 500
    """Of the starts."""
    out: Path | None = None
    """PNG to write; runs/NAME_rollouts.png, or training.png in the run's folder."""

    @property
    def picture(self) -> Path:
        """The PNG."""
        if self.out is not None:
            return self.out
        if self.is_run:
            return Path(self.what) / "training.png"
        return Path("runs") / f"{folder_name(self.what)}_rollouts.png"

    @property
    def is_run(self) -> bool:
        """Whether the folder of a run was named."""
        return (Path(self.what) / "log.csv").is_file()

    def run(self) -> dict[str, Any]:
        """Draw and return what was drawn.

        Raises:
            ValueError: no such robot, case or model, or a number out of range.
        """
        out = self.picture
        if self.is_run:
            log = plot_training(Path(self.what), out)
            print(f"{out}: {len(log['step'])} validations")
            return {"run": self.what, "log": log}
        scene = load_scene(self.what)
        expect_at_least(2, rows=self.rows)
        protocol = protocol_of(scene)
        case = self.case or next(iter(protocol.cases))
        if case not in protocol.cases:
            known = ", ".join(protocol.cases)
            raise ValueError(f"unknown case '{case}', expected one of {known}")
        steps = min(protocol.horizons) if self.steps is None else self.steps
        expect_at_least(1, steps=steps)
        source = protocol.cases[case]
        place = scene_of(source)
        model = from_pretrained(self.model or self.what, scene).to(self.device)
        traces = compare_traces(
            source,
            dynamics_of(model if place is scene else model.with_terrain(place)),
            MujocoDynamics(place),
            steps,
            self.rows,
            self.seed,
            case in protocol.random_actions,
        )
        plot_traces(traces, out)
        print(f"{out}: {self.what}, {case}, {self.rows} trajectories of {steps} steps")
        return {"scene": self.what, "case": case, **_figures(traces)}


def _figures(traces: Traces) -> dict[str, Any]:
    """What the figure shows, for JSON."""
    gaps = traces.gaps or {}
    return {
        "seconds": traces.seconds.tolist(),
        "errors": {k: v.mean(0).tolist() for k, v in traces.errors.items()},
        "energies": {k: v.tolist() for k, v in traces.energies.items()},
        "gaps": {k: v.tolist() for k, v in gaps.items()},
    }
