"""``nerd finetune``: a model taught by recorded trajectories."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from torchrl_nerd.cli.command import DeviceCommand
from torchrl_nerd.cli.options import Flat, Positional, SceneName, recorded_scene
from torchrl_nerd.configs import FinetuneConfig
from torchrl_nerd.data.log_files import load_recording
from torchrl_nerd.files import writable_folder
from torchrl_nerd.training.finetune_run import finetune


@dataclass(frozen=True)
class Finetune(DeviceCommand):
    """Fine-tune a model, or fit an analytic step's parameters, on recorded trajectories.

    Example: nerd finetune cube --from cube_tosses.npz --out runs/cube_tosses

    Example: nerd finetune cube --from cube_tosses.npz --model runs/cube/best
    """

    scene: Positional[SceneName]
    recorded: Annotated[Path, tyro.conf.arg(name="from")]
    """Recorded trajectories, npz or CSV."""
    out: Path | None = None
    """Folder of the run; default runs/SCENE_finetuned."""
    model: str | None = None
    """Where to start: a shipped model, a checkpoint folder, or analytic (one free body with
    physical parameters); default analytic for the cube, else the robot's model."""
    config: Flat[FinetuneConfig] = field(default_factory=FinetuneConfig)
    quiet: bool = False
    """Show no progress bar."""

    def plan(self) -> list[str]:
        """How many trajectories there are to learn from, once they pass the checks."""
        _, parts = load_recording(self.recorded, recorded_scene(self.scene))
        return [
            f"{name}: {len(members)} trajectories" for name, members in parts.items()
        ]

    def run(self) -> dict[str, Any]:
        """Train, save the best model on validation trajectories and return its card."""
        scene = recorded_scene(self.scene)
        out = writable_folder(self.out or Path("runs") / f"{scene.name}_finetuned")
        how = self.config, self.model, self.quiet, self.device
        card = finetune(scene, self.recorded, out, *how)
        results = card["finetuning"]
        errors = ", ".join(
            f"{name.removeprefix('validation_')} {value:.4f}"
            for name, value in results.items()
            if name.startswith("validation_")
        )
        print(
            f"best model in {out}: {errors} on validation trajectories; within 5% of "
            f"that after {results['converged_epoch']:.2f} epochs"
        )
        return card
