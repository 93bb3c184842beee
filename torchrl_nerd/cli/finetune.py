"""``nerd finetune``: a model taught by recorded trajectories."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar

import torch
import tyro
from torch import Tensor

from torchrl_nerd.analytic import FreeBodyPenaltyStep
from torchrl_nerd.checkpoint import CARD, make_card, save_checkpoint
from torchrl_nerd.cli.command import DeviceCommand
from torchrl_nerd.cli.options import Flat, Positional, SceneName, recorded_scene
from torchrl_nerd.configs import FinetuneConfig
from torchrl_nerd.data.log_files import load_recording
from torchrl_nerd.data.recorded import Recording
from torchrl_nerd.dynamics import Model
from torchrl_nerd.files import check_writable, folder_name, read_json, write_json
from torchrl_nerd.settings import SettingError
from torchrl_nerd.training.finetune import ANALYTIC, FineTuner, start_model

OF_PHYSICS = ("evaluations",)  # settings that the other kind of training ignores
OF_NETWORKS = (
    *("epochs", "batch_size", "sequence_length", "short_history_fraction"),
    *("lr", "clip", "validate_every", "patience"),
)


@dataclass(frozen=True)
class Finetune(DeviceCommand):
    """Fine-tune a model, or fit an analytic step's parameters, on recorded trajectories.

    Example: nerd finetune cube --from cube_tosses.npz --out runs/cube_tosses

    Example: nerd finetune cube --from cube_tosses.npz --model cube_real-mlp
    """

    interrupted: ClassVar[str] = "the best model so far is in the folder of the run"
    scene: Positional[SceneName]
    recorded: Annotated[Path, tyro.conf.arg(name="from")]
    """Recorded trajectories, npz or CSV."""
    out: Path | None = None
    """Folder of the run; default runs/SCENE_finetuned."""
    model: str | None = None
    """Where to start: a shipped model, a checkpoint folder, or analytic (one free body with
    physical parameters); default analytic for the cube, else the robot's model."""
    config: Flat[FinetuneConfig] = field(default_factory=FinetuneConfig)

    @property
    def folder(self) -> Path:
        """Of the new model."""
        name = folder_name(recorded_scene(self.scene).name)
        return self.out or Path("runs") / f"{name}_finetuned"

    def inputs(self) -> tuple[Recording, dict[str, Tensor], Model]:
        """The log, its trajectories for each purpose, and the model to begin with.

        Raises ValueError for a folder that holds a model or cannot be written, and for
        options that this kind of model does not use.
        """
        scene, out = recorded_scene(self.scene), self.folder
        if (out / CARD).exists():
            raise ValueError(f"{out} already holds a model: choose another --out")
        check_writable(out / CARD)
        recording, split = load_recording(self.recorded, scene)
        model = start_model(scene, self.model).to(self.device)
        self._refuse_unused(isinstance(model, FreeBodyPenaltyStep))
        return recording, split, model

    def _refuse_unused(self, is_fit: bool) -> None:
        unused, default = OF_NETWORKS if is_fit else OF_PHYSICS, FinetuneConfig()
        changed = [x for x in unused if getattr(self.config, x) != getattr(default, x)]
        if changed:
            options = ", ".join(f"--{name.replace('_', '-')}" for name in changed)
            what = "physical parameters, whose fit" if is_fit else "a network, which"
            raise SettingError(f"expected no {options} for {what} does not use them")

    def plan(self) -> list[str]:
        """How many trajectories there are to learn from, once they pass the checks."""
        recording, split, model = self.inputs()
        parts = split["train"], split["validation"]
        FineTuner(model, recording, *parts, self.config)  # refuses what it cannot learn
        return [f"{name}: {len(part)} trajectories" for name, part in split.items()]

    def run(self) -> dict[str, Any]:
        """Train on the log's training trajectories; return the best model's card.

        The folder gets its checkpoint and the validation errors, ``curve.json``.
        """
        recording, split, model = self.inputs()
        scene, out = model.scene, self.folder
        made = {
            "start": self.model or (ANALYTIC if model.kind == ANALYTIC else scene.name),
            "device": self.device,
            "threads": torch.get_num_threads(),
            "trajectories": {name: len(members) for name, members in split.items()},
        }

        def keep(best: Model) -> None:
            results = {**made, **tuner.card()["finetuning"]}
            if isinstance(best, FreeBodyPenaltyStep):
                results["parameters"] = best.values()
            save_checkpoint(best, out, make_card(best, {"finetuning": results}))
            write_json(out / "curve.json", {"curve": tuner.curve})

        parts = split["train"], split["validation"]
        tuner = FineTuner(model, recording, *parts, self.config, self.quiet, keep)
        keep(tuner.run())
        card = read_json(out / CARD)
        results, prefix = card["finetuning"], "validation_"
        errors = ", ".join(
            f"{name.removeprefix(prefix)} {value:.3g}"
            for name, value in results.items()
            if name.startswith(prefix)
        )
        print(
            f"best model in {out}: {errors} on validation trajectories; within 5% of "
            f"that after {results['converged_epoch']:.2f} epochs"
        )
        return card
