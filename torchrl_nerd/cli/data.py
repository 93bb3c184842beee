"""``nerd data``: a data set of random trajectories in MuJoCo, or of recorded ones."""

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import tyro

from torchrl_nerd.cli.command import Command
from torchrl_nerd.cli.options import Flat, SceneOptions, recorded_scene
from torchrl_nerd.configs import DataConfig
from torchrl_nerd.data.cluster import ray_map
from torchrl_nerd.data.generate import (
    CARD,
    Draw,
    draw_chunk,
    expect_few_dropped,
    generate,
    open_card,
)
from torchrl_nerd.data.log_files import load_recording, write_recording
from torchrl_nerd.data.simulate import SEGMENT, simulate
from torchrl_nerd.data.strategies import Strategy, preset_strategy, strategy
from torchrl_nerd.files import check_writable, folder_name, read_json
from torchrl_nerd.robots import preset_of
from torchrl_nerd.scenes import Scene
from torchrl_nerd.settings import expect_at_least
from torchrl_nerd.training.policy_data import along_policies


@dataclass(frozen=True)
class Data(SceneOptions, Command):
    """Generate random trajectories in MuJoCo, or convert recorded ones.

    An interrupted command resumes when it is run again.

    Example: nerd data cartpole --out datasets/cartpole --trajectories 20000

    Example: nerd data cube --from cube_tosses.npz --out datasets/cube_tosses

    Example: nerd data cartpole --vary mass:pole=0.3:3.0 motor=0.6:1.4

    Example: nerd data cartpole --vary preset --strategy changing --steps 200

    Example: nerd data ant --trajectories 1000000 --ray auto

    Example: nerd data ant --policy runs/ppo_ant --out datasets/ant_policy
    """

    out: Path | None = None
    """Folder of the data set; default datasets/SCENE."""
    recorded: Annotated[Path | None, tyro.conf.arg(name="from")] = None
    """File of recorded trajectories (npz or CSV); units and frames are checked."""
    config: Flat[DataConfig] = field(default_factory=DataConfig)
    policy: tuple[Path, ...] = ()
    """Folders of policies (see examples/ppo.py) that act, from the resets of their tasks.
    Each gets an equal share of the trajectories."""
    noise: float = 0.5
    """Largest standard deviation of the noise on a policy's actions, in [-1, 1]."""
    strategy: Strategy | None = None
    """Another way to draw starts and torques than the preset's, see docs/training.md.
    With `changing`, each hidden parameter of --vary changes with a chance of a half, once
    in half of the trajectories, after a multiple of 16 steps."""
    ray: str | None = None
    """Ray cluster that generates the same data: HOST:PORT, auto, or local."""
    quiet: bool = False
    """Show no progress bar."""

    @property
    def folder(self) -> Path:
        """Of the data set that is generated."""
        drawn_by = "policy" if self.policy else self.strategy
        names = filter(None, (self.run_name, drawn_by))
        return self.out or Path("datasets") / "-".join(names)

    def drawing(self, scene: Scene) -> tuple[str, Draw] | None:
        """Name and function that draw: the policy's, the strategy's or the preset's.

        Raises:
            ValueError: a strategy beside a policy, one that does not fit the robot, or
                too few steps for hidden parameters to change.
        """
        if self.policy and self.strategy is not None:
            raise ValueError("expected --strategy without --policy")
        if self.policy:
            return along_policies(scene, self.policy, self.noise)
        if self.strategy is None:
            return preset_strategy(scene)
        if self.strategy == "changing":
            expect_at_least(SEGMENT + 1, steps=self.config.steps)
        return self.strategy, strategy(scene, self.strategy)

    def inputs(self) -> tuple[Scene, tuple[str, Draw] | None]:
        """The robot and how its trajectories are drawn; options that misfit are refused."""
        is_noisy = self.noise != type(self).noise
        if self.recorded is not None:
            drawing = self.policy, self.ray, self.reference, self.vary, self.strategy
            other = self.config != preset_of(self.scene).data
            if any(drawing) or other or is_noisy:
                raise ValueError("expected --from without options that draw data")
            return recorded_scene(self.scene), None
        if not self.policy and is_noisy:
            raise ValueError(
                "expected --noise with --policy, whose actions it is added to"
            )
        scene = self.load()
        return scene, self.drawing(scene)

    def plan(self) -> list[str]:
        """How many trajectories would be drawn, their size, and how many exist."""
        scene, strategy = self.inputs()
        if self.recorded is not None:
            recording, _ = load_recording(self.recorded, scene)
            return [f"convert {len(recording)} recorded trajectories"]
        name, draw = strategy or (None, partial(simulate, scene))
        out, wanted = self.folder, self.config.trajectories
        existing = open_card(scene, self.config, out, name)["trajectories"]
        check_writable(out / CARD)
        size = draw_chunk(draw, self.config, (0, 1)).bytes()
        return [
            f"draw {wanted} trajectories of {scene.name}, {size * wanted / 1e9:.2g} GB, "
            f"in {out}, where {existing} exist"
        ]

    def run(self) -> dict[str, Any]:
        """Write the data set and return its card; bad input or data raise ValueError."""
        scene, strategy = self.inputs()
        if self.recorded is not None:
            name = f"{folder_name(scene.name)}_recorded"
            out = self.out or Path("datasets") / name
            card = write_recording(self.recorded, scene, out)
            print(*card["checks"], sep="\n")
            count = card["trajectories"]
            print(f"{count} recorded trajectories in {out}: they pass all checks")
            return card
        out = self.folder
        mapper = partial(ray_map, address=self.ray) if self.ray else map
        generate(scene, self.config, out, self.quiet, strategy, mapper)
        card = read_json(out / CARD)
        print(
            f"{card['trajectories']} trajectories in {out}, {card['dropped']} dropped"
        )
        expect_few_dropped(card)
        return card
