"""Return in MuJoCo against minutes of learning, a line for each dynamics.

python experiments/plot_time_to_policy.py RESULTS.json PICTURE.svg
"""

import sys
from pathlib import Path

from matplotlib.figure import Figure

from torchrl_nerd.evaluation.results import read_results


def draw(source: Path, picture: Path) -> None:
    """Draw what `time_to_policy.py` wrote."""
    found = read_results(source)["results"]
    figure = Figure(figsize=(6.4, 3.6), layout="constrained")
    axes = figure.subplots()
    for name, curve in found["curves"].items():
        minutes = [point["seconds"] / 60 for point in curve]
        returns = [point["return"] for point in curve]
        axes.plot(minutes, returns, marker="o", markersize=3, label=name)
    axes.axhline(found["wanted"], color="0.6", linewidth=0.8, linestyle="--")
    axes.set_xlabel("minutes of one thread")
    axes.set_ylabel("return in MuJoCo (↑ better)")
    axes.set_title(f"{found['configuration']['task']}: PPO in each dynamics alone")
    axes.legend(frameon=False)
    figure.savefig(picture)


if __name__ == "__main__":
    draw(Path(sys.argv[1]), Path(sys.argv[2]))
