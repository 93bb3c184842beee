"""Error against history, and inferred against actual parameters, as one picture.

python -m experiments.hidden_parameters.plot RESULTS.json PICTURE.svg
"""

from pathlib import Path
from typing import Any

import tyro
from matplotlib.figure import Figure

from torchrl_nerd.evaluation.results import read_results

SHOWN = 200  # points of a probe


def curves(axes: Any, found: dict[str, Any], steps: str) -> None:
    """Mean error over so many steps, inside the ranges, a line per candidate."""
    rows = [row for row in found["errors"] if row["region"] == "inside"]
    rows = [row for row in rows if row["name"] != "mujoco.sysid"]  # of one length alone
    quantity = list(rows[0]["errors"][steps])[-1]
    lengths = sorted({row["history"] for row in rows})
    for name in dict.fromkeys(row["name"] for row in rows):
        own = [row for row in rows if row["name"] == name]
        errors = [row["errors"][steps][quantity]["mean"] for row in own]
        seen = [row["history"] for row in own]
        axes.plot(seen, errors, marker="o", markersize=3, label=name)
    learned = [row for row in rows if "fitted" not in row["name"]]
    lowest = min(row["errors"][steps][quantity]["mean"] for row in learned)
    axes.set_title(f"{steps} steps after the history: lower is better", fontsize=9)
    axes.set_xscale("symlog", linthresh=1)
    axes.set_xticks(lengths, lengths)
    axes.set_yscale("log")
    axes.set_ylim(bottom=lowest / 3)  # a fit of the right engine goes to zero
    axes.set_xlabel("steps of history")
    axes.set_ylabel(f"mean error of {quantity} (rad)")


def points(axes: Any, found: dict[str, Any], parameter: str) -> None:
    """Actual and inferred parameter of the first model, both -1 to 1."""
    row = found["probe"][0]
    column = list(row["explained"]).index(parameter)
    actual, guess = zip(
        *(point[column] for point in row["points"][:SHOWN]), strict=True
    )
    axes.plot(actual, guess, ".", markersize=3)
    axes.set_xlabel(f"actual {parameter}")
    axes.set_ylabel("read from the network's memory")
    share = f"{row['explained'][parameter]:.0%} of the variance"
    axes.set_title(f"what {row['name']} knows: {share}", fontsize=9)


def main(results: tyro.conf.Positional[Path], path: tyro.conf.Positional[Path]) -> None:
    """Draw the results of `hidden_parameters`."""
    found = read_results(results)["results"]
    best = max(found["probe"][0]["explained"].items(), key=lambda item: item[1])[0]
    figure = Figure(figsize=(11.0, 4.0), layout="constrained")
    panels = figure.subplots(1, 3)
    for axes, steps in zip(panels, ("20", "100"), strict=False):
        curves(axes, found, steps)
    names = panels[0].get_legend_handles_labels()
    figure.legend(*names, fontsize=8, loc="outside lower center", ncols=6)
    points(panels[2], found, best)
    figure.savefig(path)


if __name__ == "__main__":
    tyro.cli(main)
