"""``nerd plot``: error, energy and distance to the terrain over time."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchrl_nerd.cli.command import DeviceCommand
from torchrl_nerd.cli.options import Positional
from torchrl_nerd.dynamics import MujocoDynamics, dynamics_of
from torchrl_nerd.envs.resolve import resolve_model
from torchrl_nerd.evaluation.plots import plot_traces
from torchrl_nerd.evaluation.policy_transfer import model_title
from torchrl_nerd.evaluation.rollout_error import scene_of
from torchrl_nerd.evaluation.traces import compare_traces
from torchrl_nerd.files import folder_name
from torchrl_nerd.robots import load_scene, protocol_of
from torchrl_nerd.settings import expect_at_least, look_up


@dataclass(frozen=True)
class Plot(DeviceCommand):
    """Error, energy and distance to the terrain over time, of one set of rollouts.

    Example: nerd plot double_pendulum --case "terrain 3" --out rollouts.png
    """

    scene: Positional[str]
    """Name of the robot, as for eval."""
    dynamics: str = "nerd"
    """Compared with MuJoCo: nerd, hybrid, analytic, a shipped model or a folder."""
    case: str | None = None
    """Of the robot's evaluation protocol, as eval names them; the first by default."""
    trajectories: int = 64
    """Rollouts of each dynamics."""
    steps: int | None = None
    """Control steps; the protocol's shortest horizon by default."""
    seed: int = 500
    """Of the initial states."""
    out: Path | None = None
    """PNG to write; runs/NAME_rollouts.png by default."""

    @property
    def figure(self) -> Path:
        """The PNG."""
        return self.out or Path("runs") / f"{folder_name(self.scene)}_rollouts.png"

    def run(self) -> dict[str, Any]:
        """Plot and return what the figure shows.

        Raises:
            ValueError: no such robot, case or dynamics, or a number out of range.
        """
        scene, out = load_scene(self.scene), self.figure
        expect_at_least(2, trajectories=self.trajectories)
        protocol = protocol_of(scene)
        case = self.case or next(iter(protocol.cases))
        source = look_up("case", case, protocol.cases)
        steps = min(protocol.horizons) if self.steps is None else self.steps
        expect_at_least(1, steps=steps)
        place, name = scene_of(source), self.dynamics
        model = resolve_model(name, scene)
        model = model if place is scene else model.with_terrain(place)
        both = (dynamics_of(model.to(self.device)), MujocoDynamics(place))
        is_random = case in protocol.random_actions
        args = (steps, self.trajectories, self.seed, is_random)
        traces = compare_traces(source, both, *args)
        names = (model_title(scene, name), "MuJoCo")
        title = f"{self.scene}, {case}: {names[0]} ({both[0].kind}) against MuJoCo"
        plot_traces(traces, names, title, out)
        print(f"{out}: {self.trajectories} trajectories of {steps} steps, {case}")
        results: dict[str, Any] = {"scene": self.scene, "case": case, "dynamics": names}
        results["seconds"] = traces.seconds.tolist()
        results["errors"] = {k: v.mean(0).tolist() for k, v in traces.errors.items()}
        results["energies"] = [line.tolist() for line in traces.energies]
        results["distances"] = [line.tolist() for line in traces.distances or ()]
        return results
