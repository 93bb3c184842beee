"""``nerd train``: the model that ships for a scene, or one of your own."""

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch

from torchrl_nerd.checkpoint import from_pretrained, load_checkpoint, save_checkpoint
from torchrl_nerd.cli.command import DeviceCommand
from torchrl_nerd.cli.options import Flat, SceneOptions
from torchrl_nerd.configs import DataConfig, TrainConfig
from torchrl_nerd.data.generate import CARD, generate, load_data, read_card
from torchrl_nerd.data.strategies import preset_strategy
from torchrl_nerd.files import check_writable, read_json
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.robots import PRESETS, preset_of, protocol_of, source_of
from torchrl_nerd.scenes import Scene
from torchrl_nerd.settings import SettingError, expect_at_least, expect_same
from torchrl_nerd.training.log import LoggerName
from torchrl_nerd.training.start import begin_from, find_symmetry, make_model
from torchrl_nerd.training.symmetry import Symmetry
from torchrl_nerd.training.trainer import STATE, Trainer

Kind = Literal["learned", "hybrid"]


@dataclass(frozen=True)
class Train(SceneOptions, DeviceCommand):
    """Train a model of a scene, by default with the settings of its training preset.

    Robots without a preset share one. Missing data are generated first. An interrupted
    run resumes with the same command.

    Example: nerd train cartpole --out runs/cartpole --network mlp-4x64

    Example: nerd train double_pendulum --kind hybrid

    Example: nerd train ant --init-from ant --data datasets/ant datasets/ant_policy
    """

    kind: Kind = "learned"
    """A learned model, or a hybrid where the preset has one."""
    out: Path | None = None
    """Folder of the run; default runs/SCENE, for a hybrid runs/SCENE-hybrid."""
    data: tuple[Path, ...] = ()
    """Folders of data sets; default datasets/SCENE, which is generated if it does not
    exist."""
    init_from: str | None = None
    """Continue training from a shipped model (its name) or a checkpoint (its folder)."""
    config: Flat[TrainConfig] = field(default_factory=TrainConfig)
    export: Path | None = None
    """Folder to copy the checkpoint to that the preset chooses, best or last."""
    logger: LoggerName = "tensorboard"
    """Where metrics go besides log.csv; csv: nowhere else."""
    threads: int | None = None
    """Processor threads of torch; default torch's own choice."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.threads is not None:
            expect_at_least(1, threads=self.threads)
        if (self.kind == "hybrid") != (self.config.step is not None):
            known = [name for name, preset in PRESETS.items() if preset.hybrid]
            raise SettingError(
                f"expected --kind hybrid with --step, or a scene whose preset has a hybrid "
                f"({', '.join(known)}), got kind {self.kind} and step {self.config.step}"
            )

    @property
    def folders(self) -> tuple[Path, tuple[Path, ...]]:
        """Of the run and of its data sets."""
        name = self.run_name
        run = name if self.kind == "learned" else f"{name}-hybrid"
        return self.out or Path("runs") / run, self.data or (Path("datasets") / name,)

    def initial(self, scene: Scene) -> NeRD | None:
        """The model whose training continues, or None; refuse an analytic step."""
        if self.init_from is None:
            return None
        model = from_pretrained(self.init_from, scene)
        if not isinstance(model, NeRD):
            raise ValueError(
                f"expected a learned or hybrid model to continue from, got the analytic "
                f"step '{self.init_from}'"
            )
        return model

    def plan(self) -> list[str]:
        """Which model would be trained on which data, and what exists already."""
        scene, (out, folders) = self.load(), self.folders
        if self.is_to_draw(folders):
            drawn = preset_of(self.scene).data
            self.expect_long(drawn)
            data = f"draw {drawn.trajectories} trajectories, to {folders[0]}"
        else:
            for folder in folders:
                self.expect_long(read_card(scene, folder)[1])
            data = f"use the data in {', '.join(map(str, folders))}"
        self.expect_writable(out)
        initial = self.initial(scene)
        config, symmetry = find_symmetry(scene, self.config, initial)
        self.expect_own(out, scene, config)
        model = self.untrained(scene, initial, config, symmetry)
        weights = sum(weight.numel() for weight in model.network.parameters())
        count = getattr(model.config, "symmetries", 1)
        having = f" with symmetries {count}" if count > 1 else ""
        return [
            data,
            f"{'resume the' if (out / STATE).exists() else 'begin a'} run in {out}",
            f"train the {weights} weights of a {model.kind} model{having} for "
            f"{self.config.total_steps} updates",
        ]

    def untrained(
        self,
        scene: Scene,
        initial: NeRD | None,
        config: TrainConfig,
        symmetry: Symmetry | None,
    ) -> NeRD:
        """The model whose training begins; settings that do not fit are refused."""
        if initial is not None:
            return begin_from(initial, scene, config, symmetry)
        return make_model(scene, config, symmetry=symmetry)

    def is_to_draw(self, folders: tuple[Path, ...]) -> bool:
        """Whether data are drawn, or finished; never to a folder that was named in vain."""
        is_named = self.data and not (folders[0] / CARD).exists()
        return not is_named and _is_missing(folders, preset_of(self.scene).data)

    def expect_long(self, data: DataConfig) -> None:
        """Refuse trajectories that are too short before they are drawn."""
        if data.steps < self.config.longest:
            raise ValueError(
                f"expected trajectories of at least {self.config.longest} steps, got "
                f"{data.steps}: draw them with `nerd data {self.scene} --steps`"
            )

    def expect_writable(self, out: Path) -> None:
        """Refuse folders of the run and of ``--export`` that cannot be written."""
        for folder in filter(None, (out, self.export)):
            check_writable(folder / "card.json")

    def expect_own(self, out: Path, scene: Scene, config: TrainConfig) -> None:
        """Refuse a folder that holds a run of other settings."""
        if (out / STATE).exists():
            asked = {"config": asdict(config), "scene_hash": scene.hash}
            expect_same(f"{out} holds a run", read_json(out / STATE), asked)

    def run(self) -> dict[str, Any]:
        """Train and return the card of the checkpoint that the preset chooses."""
        scene, preset = self.load(), preset_of(self.scene)
        (out, folders), initial = self.folders, self.initial(scene)
        self.expect_writable(out)
        config, symmetry = find_symmetry(scene, self.config, initial)
        # refuses before data are drawn, or read
        self.untrained(scene, initial, config, symmetry)
        if self.is_to_draw(folders):
            self.expect_own(out, scene, config)
            self.expect_long(preset.data)
            generate(scene, preset.data, folders[0], self.quiet, preset_strategy(scene))
        if self.threads is not None:
            torch.set_num_threads(self.threads)
        protocol = protocol_of(scene)
        trainer = Trainer(
            scene,
            load_data(scene, *folders),
            source_of(scene),
            config,
            out,
            self.device,
            horizons=protocol.horizons[:2],
            # passive motion tells nothing of motors
            random_actions=bool(protocol.random_actions or scene.variation),
            quiet=self.quiet,
            logger=self.logger,
            init_from=initial,
        )
        trainer.run()
        chosen = out / preset.exports
        card = read_json(chosen / "card.json")
        if self.export is not None:
            save_checkpoint(load_checkpoint(chosen, scene), self.export, card)
        print(f"{preset.exports} checkpoint in {chosen}: {_errors(card)}")
        return card


def _is_missing(folders: tuple[Path, ...], config: DataConfig) -> bool:
    """Whether a single data set is yet to be generated, or to be finished."""
    if len(folders) != 1 or not (path := folders[0] / CARD).exists():
        return len(folders) == 1
    card = read_json(path)
    drawn = [card.get(key) for key in ("trajectories", "dropped")]
    counts = [count for count in drawn if type(count) is int]  # odd ones: refused later
    is_whole = counts != drawn or sum(counts) >= config.trajectories
    return card.get("config") == asdict(config) and not is_whole


def _errors(card: dict[str, Any]) -> str:
    """Validation errors of a card in one line."""
    parts = []
    for horizon, by_name in card.get("validation_error", {}).items():
        for name, error in by_name.items():
            mean = error["mean"]
            shown = "not finite" if mean is None else f"{mean:.2g} {error['unit']}"
            parts.append(f"{name} {shown} at {horizon} steps")
    return ", ".join(parts) or "not validated"
