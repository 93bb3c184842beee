"""The ``nerd`` command: data, train, finetune, eval, transfer, explain, bench."""

import io
import sys
from collections.abc import Sequence
from contextlib import redirect_stderr
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro

from torchrl_nerd.checkpoint import from_pretrained, load_checkpoint, save_checkpoint
from torchrl_nerd.data.generate import CARD, DataConfig, generate, load_data
from torchrl_nerd.data.recorded import REAL, SHIPPED, load_tosses, write_tosses
from torchrl_nerd.dynamics import MujocoDynamics, NeRDDynamics
from torchrl_nerd.dynamics.nerd import Inference
from torchrl_nerd.evaluation.bench.plot import plot_race
from torchrl_nerd.evaluation.bench.report import bench
from torchrl_nerd.evaluation.bench.table import bench_table
from torchrl_nerd.evaluation.explain.report import explain
from torchrl_nerd.evaluation.explain.table import report_table
from torchrl_nerd.evaluation.policy import load_policy, make_actor
from torchrl_nerd.evaluation.policy_transfer import transfer, transfer_table
from torchrl_nerd.evaluation.protocols import protocol_of
from torchrl_nerd.evaluation.rollout_error import passive_errors, scene_of
from torchrl_nerd.evaluation.toss_error import STATES
from torchrl_nerd.evaluation.toss_table import compare, mujoco_baselines, toss_table
from torchrl_nerd.evaluation.unseen_terrain import UNSEEN_TERRAIN
from torchrl_nerd.files import folder_name, read_json, writable_folder, write_json
from torchrl_nerd.scenes import Scene, is_import, load_scene
from torchrl_nerd.settings import SettingError
from torchrl_nerd.tasks import make_task
from torchrl_nerd.training.finetune import FinetuneConfig
from torchrl_nerd.training.finetune_run import finetune
from torchrl_nerd.training.recipes import RECIPES, recipe_of
from torchrl_nerd.training.trainer import TrainConfig, Trainer

Positional = tyro.conf.Positional
Flat = tyro.conf.OmitArgPrefixes


@dataclass(frozen=True)
class Data:
    """Generate random trajectories of the true dynamics, or take over recorded ones.

    Example: nerd data cartpole --out datasets/cartpole --trajectories 20000
    Example: nerd data cube --from cube_tosses.npz --out datasets/cube_tosses
    """

    scene: Positional[str]
    """Name of the robot: cartpole, double_pendulum, dm_control/DOMAIN-TASK, gymnasium/ID,
    or an MJCF file."""
    out: Path | None = None
    """Folder of the data set; datasets/SCENE by default."""
    recorded: Annotated[Path | None, tyro.conf.arg(name="from")] = None
    """Recorded cube tosses (npz or CSV): units and frames are checked by physics."""
    config: Flat[DataConfig] = field(default_factory=DataConfig)
    json: Path | None = None
    """Write the figures to this file."""
    quiet: bool = False
    """No progress bar."""

    def run(self) -> dict[str, Any]:
        """Write the data set and return its card."""
        if self.recorded is not None:
            scene = real_scene(self.scene)
            out = self.out or Path("datasets") / f"{scene.name}_recorded"
            card = write_tosses(self.recorded, scene, out)
            print("\n".join(card["checks"]))
            print(f"{card['trajectories']} recorded tosses in {out}: they fit physics")
            return card
        scene = load_scene(self.scene)
        out = self.out or Path("datasets") / folder_name(self.scene)
        generate(scene, self.config, out, self.quiet)
        card = read_json(out / CARD)
        print(
            f"{card['trajectories']} trajectories in {out}, {card['dropped']} dropped"
        )
        return card


@dataclass(frozen=True)
class Train:
    """Train a NeRD; without options, exactly as the shipped model of the scene.

    Robots of others get one recipe for all, validated from their own sampling ranges.
    Missing data are generated first. A killed run goes on where it stopped.
    Example: nerd train cartpole --out runs/cartpole --network mlp
    """

    scene: Positional[str]
    """Name of the robot: cartpole, double_pendulum, dm_control/DOMAIN-TASK, gymnasium/ID,
    or an MJCF file."""
    out: Path | None = None
    """Folder of the run; runs/SCENE by default."""
    data: Path | None = None
    """Folder of the data set; datasets/SCENE by default."""
    config: Flat[TrainConfig] = field(default_factory=TrainConfig)
    export: Path | None = None
    """Copy the best checkpoint to this folder when done."""
    device: str = "cpu"
    """cpu or cuda."""
    threads: int | None = None
    """Processor threads; torch's own choice by default."""
    json: Path | None = None
    """Write the figures to this file."""
    quiet: bool = False
    """No progress bar."""

    def run(self) -> dict[str, Any]:
        """Train and return the card of the best checkpoint."""
        scene = load_scene(self.scene)
        recipe, name = recipe_of(self.scene), folder_name(self.scene)
        out = writable_folder(self.out or Path("runs") / name)
        folder = self.data or Path("datasets") / name
        if not (folder / CARD).exists():
            generate(scene, recipe.data, folder, self.quiet)
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
        )
        trainer.run()
        card = read_json(out / "best" / "card.json")
        if self.export is not None:
            save_checkpoint(load_checkpoint(out / "best", scene), self.export, card)
        print(f"best checkpoint in {out / 'best'}: {_curve(card)}")
        return card


@dataclass(frozen=True)
class Eval:
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
    unseen_terrain: bool = False
    """Over grounds of kinds that no training data have, in place of the paper's."""
    data: Path | None = None
    """Recorded cube tosses (npz or CSV) in place of true physics: every sub-trajectory of
    80 states."""
    split: str = "all"
    """Of recorded tosses: all, train, validation or test, by the recommended seed."""
    baselines: bool = False
    """Beside it, on recorded tosses: MuJoCo, published and fitted, and no motion."""
    device: str = "cpu"
    """cpu or cuda."""
    json: Path | None = None
    """Write the figures to this file."""

    def run(self) -> dict[str, Any]:
        """Print a table and return its rows."""
        if self.data is not None:
            return self.run_recorded(self.data)
        scene = load_scene(self.scene)
        if self.rows < 2:
            raise ValueError(f"expected at least 2 rows, got {self.rows}")
        protocol = protocol_of(scene)
        if self.unseen_terrain:
            if self.scene not in UNSEEN_TERRAIN:
                known = ", ".join(UNSEEN_TERRAIN)
                raise ValueError(
                    f"no unseen terrain for '{self.scene}', expected one of {known}"
                )
            protocol = UNSEEN_TERRAIN[self.scene]()
        model = from_pretrained(self.model or self.scene, scene).to(self.device)
        rows = []
        header = f"{'case':<13}{'steps':>6} {'quantity':<20}{'mean':>9}{'+-':>9}"
        print(f"{header}{'final':>9}{'p95':>9}  paper")
        for case, source in protocol.cases.items():
            place = scene_of(source)
            here = model if place is scene else model.over(place)
            errors = passive_errors(
                source,
                NeRDDynamics(here, inference=self.inference),
                MujocoDynamics(place),
                list(protocol.horizons),
                self.rows,
                self.seed,
                self.device,
                case in protocol.random_actions,
            )
            for horizon, by_name in errors.items():
                for name, error in by_name.items():
                    paper = protocol.published.get((case, horizon, name))
                    row = {"case": case, "steps": horizon, "quantity": name}
                    rows.append({**row, **asdict(error), "paper": paper})
                    figures = (error.mean, error.interval, error.final, error.p95)
                    line = f"{case:<13}{horizon:>6} {name:<17}{error.unit:<3}"
                    line += "".join(f"{figure:>9.5f}" for figure in figures)
                    print(f"{line}  {paper if paper is not None else '-'}")
        settings = {"rows": self.rows, "seed": self.seed, "inference": self.inference}
        return {"scene": self.scene, **settings, "errors": rows}

    def run_recorded(self, path: Path) -> dict[str, Any]:
        """The same for recorded tosses."""
        scene = real_scene(self.scene)
        model = from_pretrained(self.model or SHIPPED, scene).to(self.device)
        tosses, split = load_tosses(path, scene)
        if self.split != "all" and self.split not in split:
            expected = ", ".join(("all", *split))
            raise ValueError(f"expected split {expected}, got '{self.split}'")
        chosen = None if self.split == "all" else split[self.split]
        starts = tosses.starts(STATES, chosen)
        if len(starts) == 0:
            raise ValueError(
                f"expected a toss of at least {STATES} states in {path}, got none"
            )
        models = {"model": NeRDDynamics(model, inference=self.inference)}
        if self.baselines:
            models = {**mujoco_baselines(scene), **models}
        table = compare(models, tosses, starts)
        print(toss_table(table))
        shared = {"scene": scene.name, "split": self.split, "windows": len(starts)}
        return {**shared, **table["model"], "others": table}


@dataclass(frozen=True)
class Finetune:
    """Fine-tune on recorded tosses a model that was pretrained in MuJoCo.

    Example: nerd finetune cube --from cube_tosses.npz --out runs/cube_tosses
    Example: nerd finetune cube --from cube_tosses.npz --scratch mlp --epochs 40
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
    json: Path | None = None
    """Write the figures to this file."""
    quiet: bool = False
    """No progress bar."""

    def run(self) -> dict[str, Any]:
        """Train, save the best model on validation tosses and return its card."""
        scene = real_scene(self.scene)
        out = writable_folder(self.out or Path("runs") / f"{scene.name}_finetuned")
        start = self.model if self.scratch is None else None
        card = finetune(
            scene, self.recorded, out, self.config, start, self.scratch, self.quiet
        )
        figures = card["finetuning"]
        print(
            f"best model in {out}: {figures['validation_position_m']:.4f} m, "
            f"{figures['validation_orientation_rad']:.3f} rad on validation tosses, "
            f"after {figures['converged_epoch']:.2f} epochs within 5% of it"
        )
        return card


@dataclass(frozen=True)
class Transfer:
    """Returns of a policy in learned and in true dynamics, and the gap.

    Example: nerd transfer cartpole/swingup --policy runs/ppo
    """

    task: Positional[str]
    """Id of the task, such as cartpole/swingup."""
    policy: Path
    """Folder of a policy, as examples/ppo.py writes it."""
    dynamics: tuple[str, ...] = ("nerd", "mujoco")
    """Any of nerd, mujoco, dm_control, checkpoint folders."""
    episodes: int = 2048
    """Per dynamics."""
    seed: int = 500
    """Of the resets."""
    json: Path | None = None
    """Write the figures to this file."""

    def run(self) -> dict[str, Any]:
        """Print a table and return its rows."""
        if self.episodes < 2:
            raise ValueError(f"expected at least 2 episodes, got {self.episodes}")
        policy = load_policy(self.policy, make_task(self.task))
        actor = make_actor(policy)
        summaries = transfer(self.task, actor, self.dynamics, self.episodes, self.seed)
        print(transfer_table(summaries))
        figures = {name: asdict(summary) for name, summary in summaries.items()}
        return {"task": self.task, "seed": self.seed, "returns": figures}


@dataclass(frozen=True)
class Explain:
    """What a network sees of a scene, what is left out, and proofs that it may be.

    Example: nerd explain double_pendulum --json results/explain.json
    """

    scene: Positional[str]
    """Name of the robot: cartpole, double_pendulum, dm_control/DOMAIN-TASK, gymnasium/ID,
    or an MJCF file."""
    rows: int = 1024
    """Random states to ask the true solver about, and rows of the timing."""
    seed: int = 0
    """Of these states."""
    network: str = "tiny"
    """What to time the compact input and the paper's with."""
    timing: bool = True
    """Time them."""
    json: Path | None = None
    """Write the figures to this file."""

    def run(self) -> dict[str, Any]:
        """Print the report and return its figures."""
        scene = load_scene(self.scene)
        network = self.network if self.timing else None
        report = explain(scene, self.rows, self.seed, network)
        print(report_table(report))
        return asdict(report) | {"unused": report.unused, "derived": report.derived}


@dataclass(frozen=True)
class Bench:
    """Speed against error: the shipped models and MuJoCo, coarse and fine, in one race.

    Example: nerd bench cartpole --json results/bench.json --plot results/bench.png
    """

    scene: Positional[str]
    """Name of the robot: cartpole, double_pendulum, ant, franka, anymal, cube, ..."""
    batches: tuple[int, ...] = (1, 64, 512, 4096)
    """Rows stepped together."""
    rows: int = 256
    """Trajectories per case, for the errors."""
    rounds: int = 5
    """Turns of each contender."""
    seed: int = 500
    """Of the starts."""
    steps: int | None = None
    """Horizon of the errors; the paper's by default."""
    compile: bool = True
    """Have compiled rows."""
    threads: int | None = None
    """Processor threads; torch's own choice by default."""
    budget: tuple[float, ...] = ()
    """Largest mean errors, in the table's order: names the fastest row within them."""
    plot: Path | None = None
    """Draw the race to this PNG."""
    json: Path | None = None
    """Write the figures to this file."""

    def run(self) -> dict[str, Any]:
        """Print the tables and return their figures."""
        report = bench(
            load_scene(self.scene),
            self.batches,
            self.rows,
            self.rounds,
            self.seed,
            self.steps,
            self.compile,
            self.threads,
        )
        print(bench_table(report))
        for batch in self.batches if self.budget else ():
            choice = report.choice(batch, self.budget) or "none"
            print(f"fastest within {self.budget}, {batch} rows: {choice}")
        if self.plot is not None:
            plot_race(report, self.plot)
        return report.figures()


def real_scene(name: str) -> Scene:
    """The scene that recorded tosses are of; ``cube`` is short for it.

    Raises:
        ValueError: another robot.
    """
    if name not in REAL:
        expected = " or ".join(REAL)
        raise ValueError(f"expected {expected} for recorded tosses, got '{name}'")
    return load_scene(REAL[name])


COMMANDS = {
    "data": Data,
    "train": Train,
    "eval": Eval,
    "finetune": Finetune,
    "transfer": Transfer,
    "explain": Explain,
    "bench": Bench,
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; bad input is one sentence on stderr and exit status 2."""
    argv = list(sys.argv[1:] if argv is None else argv)
    if not argv or argv[0] in ("-h", "--help"):
        print("usage: nerd COMMAND ... (each with --help)\n")
        for name, command in COMMANDS.items():
            print(f"  {name:<10}{(command.__doc__ or '').splitlines()[0]}")
        return 0
    if argv[0] not in COMMANDS:
        return _fail(f"unknown command '{argv[0]}', expected {', '.join(COMMANDS)}")
    kind = COMMANDS[argv[0]]
    try:
        command = _parse(kind, argv)
        figures = command.run()
        if command.json is not None:
            write_json(command.json, figures)
    except (ValueError, OSError, RuntimeError) as error:
        return _fail(str(error).splitlines()[0])
    return 0


def _parse(kind: type, argv: list[str]) -> Any:
    """The command with its settings; tyro's boxes point at what cannot be read.

    Raises:
        SettingError: a setting out of range, in its own words and without a box.
    """
    said = io.StringIO()
    try:
        with redirect_stderr(said):
            default = _default(kind, argv[1:])
            return tyro.cli(
                kind, args=argv[1:], prog=f"nerd {argv[0]}", default=default
            )
    except SystemExit as stop:
        cause = stop.__context__
        while cause is not None:
            if isinstance(cause, SettingError):
                raise cause from None
            cause = cause.__cause__ or cause.__context__
        sys.stderr.write(said.getvalue())
        raise


def _default(kind: type, args: list[str]) -> Any:
    """Defaults of a command: a scene's recipe where the command has one."""
    known = [arg for arg in args if arg in RECIPES]
    scene = next(
        (arg for arg in (*known, *args) if arg in known or is_import(arg)), None
    )
    if scene is None or kind not in (Data, Train):
        return tyro.MISSING_NONPROP
    recipe = recipe_of(scene)
    if kind is Data:
        return Data(scene, config=recipe.data)
    return Train(scene, config=recipe.train)


def _fail(sentence: str) -> int:
    print(f"nerd: {sentence}", file=sys.stderr)
    return 2


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


if __name__ == "__main__":
    sys.exit(main())
