"""Validation curves in one picture: fine-tuned and from scratch.

    python experiments/measured_cube/curves.py

Reads the records of two trainings, and prints when each came to its best.
"""

import argparse
from pathlib import Path

from matplotlib.figure import Figure
from toss_plot import COLORS, STYLES

from torchrl_nerd.evaluation.results import read_results
from torchrl_nerd.training.finetune import Curve, converged

RESULTS = Path(__file__).parent / "results"
CURVES = {
    "fine-tuned": RESULTS / "finetune_cube_curve.json",
    "from scratch": RESULTS / "scratch_cube_curve.json",
}
ERRORS = {"position_m": "error (m)", "orientation_rad": "error (rad)"}


def plot_curves(curves: dict[str, Curve], path: Path) -> None:
    """Both errors on validation tosses over epochs."""
    figure = Figure(figsize=(7.0, 4.5), layout="constrained")
    panels = figure.subplots(len(ERRORS), 1, sharex=True)
    for panel, (error, label) in zip(panels, ERRORS.items(), strict=True):
        for number, (name, curve) in enumerate(curves.items()):
            epochs = [point["epoch"] for point in curve]
            errors = [point[error] for point in curve]
            style = f".{STYLES[number]}"
            panel.plot(epochs, errors, style, color=COLORS[number], label=name)
        panel.set(ylabel=label, yscale="log")
        panel.grid(alpha=0.3)
    panels[0].legend(frameon=False)
    panels[-1].set_xlabel("epochs")
    figure.savefig(path, dpi=150)


def main() -> None:
    """Draw and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=RESULTS / "finetune_curves.png")
    args = parser.parse_args()
    curves = {
        name: read_results(path)["results"]["curve"] for name, path in CURVES.items()
    }
    for name, curve in curves.items():
        print(name, {key: round(x, 4) for key, x in converged(curve).items()})
    plot_curves(curves, args.out)


if __name__ == "__main__":
    main()
