"""``nerd eval``: open-loop error against true physics or recorded tosses."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from tqdm import tqdm

from torchrl_nerd.checkpoint import from_pretrained
from torchrl_nerd.cli.command import DeviceCommand
from torchrl_nerd.cli.options import Positional, recorded_scene
from torchrl_nerd.data.log_files import load_recording
from torchrl_nerd.dynamics import Model, MujocoDynamics, dynamics_of
from torchrl_nerd.dynamics.nerd import Inference
from torchrl_nerd.evaluation.recorded_error import (
    STATES,
    compare,
    errors_as_text,
    rivals,
)
from torchrl_nerd.evaluation.rollout_error import passive_errors, scene_of
from torchrl_nerd.robots import PRESETS, load_scene, protocol_of, recorded_protocol
from torchrl_nerd.scenes import Scene


@dataclass(frozen=True)
class Eval(DeviceCommand):
    """Open-loop error of a model against true physics, beside the paper's figures.

    Robots of others start within their own sampling ranges, without and with actions.

    Example: nerd eval cartpole --json results/cartpole.json

    Example: nerd eval cube --data cube_tosses.npz --split test --baselines
    """

    scene: Positional[str]
    """Name of the robot: cartpole, double_pendulum, dm_control/DOMAIN-TASK, gymnasium/ID,
    or an MJCF file."""
    model: Path | None = None
    """Checkpoint folder; the shipped model by default."""
    rows: int = 2048
    """Trajectories per case."""
    seed: int = 500
    """Of the starts; test seeds are never used in training or validation."""
    inference: Inference = "streaming"
    """streaming, or window: the paper's recomputation."""
    bf16: bool = False
    """Network in bfloat16, state in float64: for processors that multiply in it."""
    reference: Literal["rk4"] | None = None
    """Reference solver in place of the scene's own: MuJoCo's RK4 at four times its
    substeps."""
    unseen_terrain: bool = False
    """Over grounds of kinds that no training data have, in place of the paper's."""
    data: Path | None = None
    """Recorded trajectories (npz or CSV) in place of MuJoCo: every window of `states`."""
    split: str = "all"
    """Of recorded trajectories: all, train, validation or test."""
    states: int = STATES
    """Of a window of recorded trajectories, its start among them."""
    baselines: bool = False
    """Beside it, on recorded trajectories: MuJoCo and the analytic step with the scene's
    own parameters."""
    quiet: bool = False
    """No progress bar."""

    def run(self) -> dict[str, Any]:
        """Print a table and return its rows.

        Raises:
            ValueError: fewer than 2 rows, or a robot that has no such terrain or model.
        """
        if self.data is not None:
            return self.run_recorded(self.data)
        scene = load_scene(self.scene)
        if self.rows < 2:
            raise ValueError(f"expected at least 2 rows, got {self.rows}")
        protocol = protocol_of(scene)
        if self.unseen_terrain:
            preset = PRESETS.get(self.scene)
            if preset is None or preset.unseen_terrain is None:
                known = ", ".join(n for n, p in PRESETS.items() if p.unseen_terrain)
                raise ValueError(
                    f"no unseen terrain for '{self.scene}', expected one of {known}"
                )
            protocol = preset.unseen_terrain()
        model = self._load(self.model or self.scene, scene)
        rows = []
        header = f"{'case':<13}{'steps':>6} {'quantity':<20}{'mean':>9}{'+-':>9}"
        print(f"{header}{'final':>9}{'p95':>9}  paper")
        steps = 2 * max(protocol.horizons) * len(protocol.cases)  # learned and true
        bar = tqdm(total=steps, desc=self.scene, leave=False, disable=self.quiet)
        for case, source in protocol.cases.items():
            place = scene_of(source)
            here = model if place is scene else model.with_terrain(place)
            errors = passive_errors(
                source,
                dynamics_of(here, inference=self.inference),
                MujocoDynamics(place.reference if self.reference else place),
                list(protocol.horizons),
                self.rows,
                self.seed,
                self.device,
                case in protocol.random_actions,
                bar.update,
            )
            for horizon, by_name in errors.items():
                for name, error in by_name.items():
                    paper = protocol.published.get((case, horizon, name))
                    row = {"case": case, "steps": horizon, "quantity": name}
                    rows.append({**row, **asdict(error), "paper": paper})
                    figures = (error.mean, error.interval, error.final, error.p95)
                    line = f"{case:<13}{horizon:>6} {name:<17}{error.unit:<3}"
                    line += "".join(f"{figure:>9.5f}" for figure in figures)
                    bar.write(f"{line}  {paper if paper is not None else '-'}")
        bar.close()
        settings = {"rows": self.rows, "seed": self.seed}
        settings |= {
            "inference": self.inference,
            "reference": self.reference,
            "bf16": self.bf16,
        }
        return {"scene": self.scene, **settings, "errors": rows}

    def _load(self, name: Path | str, scene: Scene) -> Model:
        """The model as it was asked for."""
        model = from_pretrained(name, scene).to(self.device)
        return (
            model.to(torch.bfloat16)
            if self.bf16 and model.kind != "analytic"
            else model
        )

    def run_recorded(self, path: Path) -> dict[str, Any]:
        """The same for recorded trajectories.

        Raises:
            ValueError: no such split, or no trajectory that is long enough.
        """
        protocol = recorded_protocol(self.scene)
        scene = recorded_scene(self.scene)
        model = self._load(self.model or protocol.model, scene)
        recording, split = load_recording(path, scene)
        if self.split != "all" and self.split not in split:
            expected = ", ".join(("all", *split))
            raise ValueError(f"expected split {expected}, got '{self.split}'")
        chosen = None if self.split == "all" else split[self.split]
        starts = recording.starts(self.states, chosen)
        if len(starts) == 0:
            raise ValueError(
                f"expected a trajectory of at least {self.states} states in {path}, got "
                "none"
            )
        models = rivals(scene) if self.baselines else {}
        models["model"] = dynamics_of(model, inference=self.inference)
        table = compare(models, scene, recording, starts, self.states)
        print(errors_as_text(table, protocol.published, self.states))
        shared = {"scene": scene.name, "split": self.split, "windows": len(starts)}
        return {**shared, **table["model"], "others": table}
