"""One run of fine-tuning: from a file of tosses to a checkpoint."""

from pathlib import Path
from typing import Any

import torch

from torchrl_nerd.checkpoint import (
    CARD,
    from_pretrained,
    make_card,
    save_checkpoint,
    shipped_models,
)
from torchrl_nerd.configs import FinetuneConfig
from torchrl_nerd.data.recorded import SHIPPED, load_tosses
from torchrl_nerd.files import read_json, write_json
from torchrl_nerd.modules.hybrid import HybridNeRD
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.scenes import Scene
from torchrl_nerd.tensor_files import write_tensors
from torchrl_nerd.training.finetune import FineTuner
from torchrl_nerd.training.toss_models import from_scratch, pretrain

PRETRAINED_NAME = f"{SHIPPED}-pretrained"
"""The shipped model that has seen simulated tosses alone."""


def finetune(
    scene: Scene,
    path: Path,
    out: Path,
    config: FinetuneConfig,
    start: str | None = None,
    scratch: str | None = None,
    quiet: bool = False,
    device: torch.device | str = "cpu",
) -> dict[str, Any]:
    """Train on the training tosses of a file; writes checkpoint and ``curve.json``.

    Args:
        scene: of the cube.
        path: of the recorded tosses.
        out: folder of the checkpoint.
        config: how.
        start: a shipped model's name or a checkpoint folder; ``"new"`` pretrains one;
            the shipped pretrained model where None.
        scratch: fresh weights instead; see `from_scratch`.
        quiet: no progress bar.
        device: of the model; the tosses stay on the processor.

    Returns:
        The card of the best model on the validation tosses.
    """
    tosses, split = load_tosses(path, scene)
    if scratch is not None:
        model = from_scratch(scene, tosses.select(split["train"]), scratch, config.seed)
    elif start == "new" or (start is None and PRETRAINED_NAME not in shipped_models()):
        model, tuner = pretrain(scene, quiet=quiet, device=device)
        card = make_card(model, {"pretraining": tuner.card()["finetuning"]})
        save_checkpoint(model, out / "pretrained", card)
    else:
        model = from_pretrained(start or PRETRAINED_NAME, scene)
    made = {
        "start": "fresh weights" if scratch else start or PRETRAINED_NAME,
        "device": str(device),
        "threads": torch.get_num_threads(),
        "tosses": {name: len(members) for name, members in split.items()},
    }

    def keep(best: NeRD) -> None:
        figures = {**made, **tuner.card()["finetuning"]}
        if isinstance(best, HybridNeRD):
            figures["simulator"] = best.analytic_step.values()
        card = make_card(best, {"finetuning": figures})
        save_checkpoint(best, out, card)
        write_json(out / "curve.json", {"curve": tuner.curve})

    parts = split["train"], split["validation"]
    tuner = FineTuner(model.to(device), tosses, *parts, config, quiet, keep)
    keep(tuner.run())
    if tuner.view.encoder is not None:
        write_tensors(out / "encoder.safetensors", tuner.view.encoder.state_dict())
    return read_json(out / CARD)
