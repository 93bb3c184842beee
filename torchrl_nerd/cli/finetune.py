"""``nerd finetune``: a pretrained model taught by recorded tosses."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from torchrl_nerd.cli.command import DeviceCommand
from torchrl_nerd.cli.options import Flat, Positional, real_scene
from torchrl_nerd.configs import FinetuneConfig
from torchrl_nerd.data.recorded import load_tosses
from torchrl_nerd.files import writable_folder
from torchrl_nerd.training.finetune_run import finetune


@dataclass(frozen=True)
class Finetune(DeviceCommand):
    """Fine-tune on recorded tosses a model that was pretrained in MuJoCo.

    Example: nerd finetune cube --from cube_tosses.npz --out runs/cube_tosses

    Example: nerd finetune cube --from tosses.npz --scratch mlp --update all --epochs 40
    """

    scene: Positional[str]
    """cube_real; cube is short for it here."""
    recorded: Annotated[Path, tyro.conf.arg(name="from")]
    """Recorded tosses, npz or CSV."""
    out: Path | None = None
    """Folder of the run; runs/SCENE_finetuned by default."""
    model: str | None = None
    """Pretrained model to start from; the shipped one by default. `new` pretrains one."""
    scratch: str | None = None
    """Start from fresh weights instead: residual, or a network's name, such as mlp."""
    config: Flat[FinetuneConfig] = field(default_factory=FinetuneConfig)
    quiet: bool = False
    """No progress bar."""

    def plan(self) -> list[str]:
        """How many tosses there are to learn from, once they fit physics."""
        _, parts = load_tosses(self.recorded, real_scene(self.scene))
        return [f"{name}: {len(members)} tosses" for name, members in parts.items()]

    def run(self) -> dict[str, Any]:
        """Train, save the best model on validation tosses and return its card."""
        scene = real_scene(self.scene)
        out = writable_folder(self.out or Path("runs") / f"{scene.name}_finetuned")
        start = self.model if self.scratch is None else None
        card = finetune(
            scene,
            self.recorded,
            out,
            self.config,
            start,
            self.scratch,
            self.quiet,
            self.device,
        )
        figures = card["finetuning"]
        print(
            f"best model in {out}: {figures['validation_position_m']:.4f} m, "
            f"{figures['validation_orientation_rad']:.3f} rad on validation tosses, "
            f"after {figures['converged_epoch']:.2f} epochs within 5% of it"
        )
        return card
