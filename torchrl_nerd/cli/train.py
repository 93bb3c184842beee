"""``nerd train``: a model as it is shipped, or one of your own."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch

from torchrl_nerd.checkpoint import (
    from_pretrained,
    load_checkpoint,
    save_checkpoint,
)
from torchrl_nerd.cli.command import DeviceCommand
from torchrl_nerd.cli.options import Flat, Positional, run_name, scene_of
from torchrl_nerd.configs import TrainConfig
from torchrl_nerd.data.generate import CARD, generate, load_data
from torchrl_nerd.data.strategies import preset_strategy
from torchrl_nerd.files import read_json, writable_folder
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.robots import preset_of, protocol_of, source_of
from torchrl_nerd.scenes import Scene
from torchrl_nerd.training import ranks
from torchrl_nerd.training.loggers import LoggerName
from torchrl_nerd.training.start import begin_from, make_model
from torchrl_nerd.training.trainer import STATE, Trainer


@dataclass(frozen=True)
class Train(DeviceCommand):
    """Train a NeRD; without options, exactly as the shipped model of the scene.

    Robots of others get one preset for all, validated from their own sampling ranges.
    Missing data are generated first. A killed run goes on where it stopped. On several
    processors or GPUs: torchrun --nproc-per-node 2 -m torchrl_nerd.cli train SCENE

    Example: nerd train cartpole --out runs/cartpole --network mlp-4x64

    Example: nerd train ant --init-from ant --data datasets/ant datasets/ant_policy
    """

    scene: Positional[str]
    """Name of the robot: cartpole, double_pendulum, dm_control/DOMAIN-TASK, gymnasium/ID,
    or an MJCF file."""
    out: Path | None = None
    """Folder of the run; runs/SCENE by default."""
    data: tuple[Path, ...] = ()
    """Folders of data sets, learned from together; datasets/SCENE by default. A single one
    is drawn if it is not there."""
    init_from: str | None = None
    """Begin with the weights and statistics of a shipped model, by name, or of a checkpoint
    folder."""
    reference: Literal["rk4"] | None = None
    """Reference solver in place of the scene's own: MuJoCo's RK4 at four times its
    substeps."""
    config: Flat[TrainConfig] = field(default_factory=TrainConfig)
    export: Path | None = None
    """Copy the preset's checkpoint, best or last, to this folder when done."""
    logger: LoggerName = "tensorboard"
    """Where figures go beside log.csv: tensorboard, wandb, mlflow, or csv for nowhere."""
    threads: int | None = None
    """Processor threads; torch's own choice by default."""
    quiet: bool = False
    """No progress bar."""

    @property
    def folders(self) -> tuple[Path, tuple[Path, ...]]:
        """Of the run and of its data sets."""
        name = run_name(self.scene, self.reference)
        return self.out or Path("runs") / name, self.data or (Path("datasets") / name,)

    def begin(self, scene: Scene) -> NeRD | None:
        """The model to start from, where there is one."""
        if self.init_from is None:
            return None
        model = from_pretrained(self.init_from, scene)
        if not isinstance(model, NeRD):
            raise ValueError(
                f"expected a learned or hybrid model to start from, got the analytic step "
                f"'{self.init_from}'"
            )
        return model

    def plan(self) -> list[str]:
        """What would be trained on what, and what is there."""
        scene, (out, folders) = scene_of(self.scene, self.reference), self.folders
        model = make_model(scene, self.config)
        start = self.begin(scene)
        if start is not None:
            model = begin_from(start, scene, self.config)
        weights = sum(weight.numel() for weight in model.network.parameters())
        count = preset_of(self.scene).data.trajectories
        return [
            f"draw {count} trajectories, to {folders[0]}"
            if _is_drawn(folders)
            else f"use the data in {', '.join(map(str, folders))}",
            f"go on with the run in {out}"
            if (out / STATE).exists()
            else f"begin a run in {out}",
            f"train {weights} weights for {self.config.total_steps} updates",
        ]

    def run(self) -> dict[str, Any]:
        """Train and return the card of the checkpoint that the preset takes."""
        scene = scene_of(self.scene, self.reference)
        preset, (out, folders) = preset_of(self.scene), self.folders
        start = self.begin(scene)
        writable_folder(out)
        ranks.join(torch.device(self.device))
        if ranks.rank() == 0 and _is_drawn(folders):
            generate(scene, preset.data, folders[0], self.quiet, preset_strategy(scene))
        ranks.wait()
        if self.threads:
            torch.set_num_threads(self.threads)
        protocol = protocol_of(scene)
        trainer = Trainer(
            scene,
            load_data(scene, *folders),
            source_of(scene),
            self.config,
            out,
            self.device,
            horizons=protocol.horizons[:2],
            random_actions=bool(protocol.random_actions),
            quiet=self.quiet,
            logger=self.logger,
            init_from=start,
        )
        trainer.run()
        made = out / preset.exports
        card = read_json(made / "card.json")
        is_first = ranks.rank() == 0
        ranks.leave()
        if is_first:
            if self.export is not None:
                save_checkpoint(load_checkpoint(made, scene), self.export, card)
            print(f"{preset.exports} checkpoint in {made}: {_curve(card)}")
        return card


def _is_drawn(folders: tuple[Path, ...]) -> bool:
    """Whether the data are yet to be drawn: a single set that is not there."""
    return len(folders) == 1 and not (folders[0] / CARD).exists()


def _curve(card: dict[str, Any]) -> str:
    """Validation error of a card in one line."""
    parts = [
        f"{name} {figures['mean']:.2g} {figures['unit']} at {horizon} steps"
        if figures["mean"] is not None
        else f"{name} not finite at {horizon} steps"
        for horizon, by_name in card.get("validation_error", {}).items()
        for name, figures in by_name.items()
    ]
    return ", ".join(parts) or "not validated"
