"""One run of fine-tuning: from a recorded log to a checkpoint."""

from pathlib import Path
from typing import Any

import torch

from torchrl_nerd.analytic import FreeBodyPenaltyStep
from torchrl_nerd.checkpoint import CARD, from_pretrained, make_card, save_checkpoint
from torchrl_nerd.configs import FinetuneConfig
from torchrl_nerd.data.log_files import load_recording
from torchrl_nerd.dynamics import Model
from torchrl_nerd.files import read_json, write_json
from torchrl_nerd.robots import recorded_protocol
from torchrl_nerd.scenes import Scene
from torchrl_nerd.training.finetune import FineTuner

ANALYTIC = "analytic"


def start_model(scene: Scene, name: str | None = None) -> Model:
    """The model that fine-tuning starts from.

    Args:
        scene: of the recording.
        name: a shipped model, a checkpoint folder, or ``"analytic"``: a step whose
            physical parameters are the published ones where there are such, else the
            scene's own. None: analytic where some are published, else the shipped model.
    """
    published = recorded_protocol(scene.name).parameters
    if name != ANALYTIC and (name is not None or not published):
        return from_pretrained(name or scene.name, scene)
    step = FreeBodyPenaltyStep(scene)
    step.set_values(dict(published))
    return step


def finetune(
    scene: Scene,
    path: Path,
    out: Path,
    config: FinetuneConfig,
    start: str | None = None,
    quiet: bool = False,
    device: torch.device | str = "cpu",
) -> dict[str, Any]:
    """Train on a log (npz or CSV) as `FineTuner`; writes checkpoint and ``curve.json``.

    Returns the card of the best model on the validation trajectories. ``start``: see
    `start_model`. ``device`` is the model's; the recording stays on the processor.
    """
    recording, split = load_recording(path, scene)
    model = start_model(scene, start).to(device)
    made = {
        "start": start or (ANALYTIC if model.kind == ANALYTIC else scene.name),
        "device": str(device),
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
    tuner = FineTuner(model, recording, *parts, config, quiet, keep)
    keep(tuner.run())
    return read_json(out / CARD)
