"""``nerd train``: a model as it is shipped, or one of your own."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from torchrl_nerd.checkpoint import load_checkpoint, save_checkpoint
from torchrl_nerd.cli.command import DeviceCommand
from torchrl_nerd.cli.options import Flat, Positional, run_name, scene_of
from torchrl_nerd.data.generate import CARD, generate, load_data
from torchrl_nerd.evaluation.protocols import protocol_of
from torchrl_nerd.files import read_json, writable_folder
from torchrl_nerd.modules.nerd import NeRD, network_config
from torchrl_nerd.training import ranks
from torchrl_nerd.training.loggers import LoggerName
from torchrl_nerd.training.recipes import recipe_of
from torchrl_nerd.training.trainer import STATE, TrainConfig, Trainer


@dataclass(frozen=True)
class Train(DeviceCommand):
    """Train a NeRD; without options, exactly as the shipped model of the scene.

    Robots of others get one recipe for all, validated from their own sampling ranges.
    Missing data are generated first. A killed run goes on where it stopped. On several
    processors or GPUs: torchrun --nproc-per-node 2 -m torchrl_nerd.cli train SCENE

    Example: nerd train cartpole --out runs/cartpole --network mlp
    """

    scene: Positional[str]
    """Name of the robot: cartpole, double_pendulum, dm_control/DOMAIN-TASK, gymnasium/ID,
    or an MJCF file."""
    out: Path | None = None
    """Folder of the run; runs/SCENE by default."""
    data: Path | None = None
    """Folder of the data set; datasets/SCENE by default."""
    fine: bool = False
    """Learn from a finer teacher: MuJoCo's RK4 at four times the scene's substeps;
    runs/SCENE-fine and datasets/SCENE-fine by default."""
    config: Flat[TrainConfig] = field(default_factory=TrainConfig)
    export: Path | None = None
    """Copy the recipe's checkpoint, best or last, to this folder when done."""
    logger: LoggerName = "tensorboard"
    """Where figures go beside log.csv: tensorboard, wandb, mlflow, or csv for nowhere."""
    threads: int | None = None
    """Processor threads; torch's own choice by default."""
    quiet: bool = False
    """No progress bar."""

    @property
    def folders(self) -> tuple[Path, Path]:
        """Of the run and of its data."""
        name = run_name(self.scene, self.fine)
        return self.out or Path("runs") / name, self.data or Path("datasets") / name

    def plan(self) -> list[str]:
        """What would be trained on what, and what is there."""
        scene, (out, data) = scene_of(self.scene, self.fine), self.folders
        network = NeRD(scene, network_config(self.config.network)).network
        weights = sum(weight.numel() for weight in network.parameters())
        count = recipe_of(self.scene).data.trajectories
        return [
            f"use the data in {data}"
            if (data / CARD).exists()
            else f"draw {count} trajectories, to {data}",
            f"go on with the run in {out}"
            if (out / STATE).exists()
            else f"begin a run in {out}",
            f"train {weights} weights for {self.config.total_steps} updates",
        ]

    def run(self) -> dict[str, Any]:
        """Train and return the card of the checkpoint that the recipe takes."""
        scene = scene_of(self.scene, self.fine)
        recipe, (out, folder) = recipe_of(self.scene), self.folders
        writable_folder(out)
        ranks.join(torch.device(self.device))
        if ranks.rank() == 0 and not (folder / CARD).exists():
            generate(scene, recipe.data, folder, self.quiet, recipe.draw(scene))
        ranks.wait()
        if self.threads:
            torch.set_num_threads(self.threads)
        protocol = protocol_of(scene)
        trainer = Trainer(
            scene,
            load_data(scene, folder),
            recipe.source(scene),
            self.config,
            out,
            self.device,
            horizons=protocol.horizons[:2],
            random_actions=bool(protocol.random_actions),
            quiet=self.quiet,
            logger=self.logger,
        )
        trainer.run()
        made = out / recipe.exports
        card = read_json(made / "card.json")
        is_first = ranks.rank() == 0
        ranks.leave()
        if is_first:
            if self.export is not None:
                save_checkpoint(load_checkpoint(made, scene), self.export, card)
            print(f"{recipe.exports} checkpoint in {made}: {_curve(card)}")
        return card


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
