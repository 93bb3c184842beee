"""The ablations of the paper, and of this project's own choices, as a table.

    python -m experiments.ablations

All variants of one seed on every scene come before those of the next; what is finished is
read, so that a run that was cut short goes on. Tables, results and a picture of each scene
are written after each seed.
"""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import tyro

from torchrl_nerd.evaluation.results import write_results
from torchrl_nerd.robots import load_scene

from .measure import Bed, Budget
from .plot import plot_ratios
from .table import markdown, rows_of
from .variants import BASE, VARIANTS

TEST_SEED = 500


@dataclass
class Options:
    """What to compare, and for how long."""

    scenes: tuple[str, ...] = tuple(VARIANTS)
    variants: tuple[str, ...] = ()
    """Beside the base; all of each scene by default."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Of weights and batches; the data are the same."""
    trajectories: int = 3_000
    """Of the data, of 100 transitions each."""
    updates: int = 700
    """Of 1,024 tokens each."""
    rows: int = 128
    """Trajectories of each test: seven grounds of the pendulum, the Ant's passive one."""
    test_seed: int = TEST_SEED
    """Of their starts."""
    out: Path = Path("runs/ablations")
    results: Path | None = None
    """Folder of results and pictures; beside the tables by default."""


def main(options: Options) -> dict[str, list[dict[str, Any]]]:
    """Print the tables; returns all results by scene."""
    budget = Budget(
        options.trajectories, options.updates, options.rows, options.test_seed
    )
    found: dict[str, list[dict[str, Any]]] = {scene: [] for scene in options.scenes}
    beds = {
        scene: Bed(load_scene(scene), budget, options.out / scene)
        for scene in options.scenes
    }
    for seed in options.seeds:
        for scene, bed in beds.items():
            asked = {BASE, *options.variants} if options.variants else VARIANTS[scene]
            for name in VARIANTS[scene]:
                if name in asked:
                    print(f"{scene}, seed {seed}: {name}", flush=True)
                    found[scene].append(bed.measure(name, seed))
            report(scene, found[scene], options)
    return found


def report(scene: str, runs: list[dict[str, Any]], options: Options) -> None:
    """One scene's tables, printed and written, with results and a picture."""
    cases = runs[0]["errors"].values()
    units = {name: error["unit"] for case in cases for name, error in case.items()}
    rows = rows_of(runs)
    lines = list(markdown(rows, units))
    print("\n".join(lines), flush=True)
    name, folder = f"ablations_{scene}", options.results or options.out
    folder.mkdir(parents=True, exist_ok=True)
    (options.out / f"{name}.md").write_text("\n".join(lines) + "\n")
    results = {"runs": runs, "rows": [asdict(row) for row in rows]}
    write_results(folder / f"{name}.json", results, list(options.seeds))
    plot_ratios(rows, folder / f"{name}.png")


if __name__ == "__main__":
    main(tyro.cli(Options))
