"""Errors, energy and the gap to the ground over time, and training over updates."""

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchrl_nerd.evaluation.plots import COLORS, STYLES, make_figure, save_figure
from torchrl_nerd.evaluation.rollout_error import unit_of
from torchrl_nerd.evaluation.traces import Traces

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SPREAD = (0.05, 0.95)
PANEL = 2.2  # inches
SEVERAL = (*COLORS, "#E69F00", "#56B4E9", "#999999")


def plot_traces(traces: Traces, path: Path) -> None:
    """Write a PNG: errors over all rows, then energy and gap of the middle one.

    Args:
        traces: of `compare_traces`.
        path: of the PNG.
    """
    scene, seconds = traces.scene, traces.seconds
    units = {name: unit_of(scene, name) for name in traces.errors}
    kinds = list(dict.fromkeys(units.values()))
    panels = len(kinds) + 1 + (traces.gaps is not None)
    figure, axes = make_figure(panels, PANEL * panels)
    for panel, unit in zip(axes, kinds, strict=False):
        names = [name for name in units if units[name] == unit]
        for color, name in zip(SEVERAL * len(names), names, strict=False):
            _spread(panel, seconds, traces.errors[name], color, name.replace("_", " "))
        panel.set_ylabel(f"error ({unit})")
        panel.set_ylim(bottom=0.0)
        panel.legend(frameon=False, fontsize=8, ncols=4, loc="upper left")
    rows = len(next(iter(traces.errors.values())))
    axes[0].set_title(
        f"mean over {rows} trajectories, band: 5% to 95%", fontsize=9, loc="left"
    )
    _both(axes[len(kinds)], seconds, traces.energies, "energy (J)")
    axes[len(kinds)].set_title("the trajectory in the middle", fontsize=9, loc="left")
    if traces.gaps is not None:
        _both(axes[-1], seconds, traces.gaps, "gap to the ground (m)")
        axes[-1].axhline(0.0, color="0.4", lw=0.8)
    axes[-1].set_xlabel("time (s)")
    save_figure(figure, path)


def _spread(
    axes: "Axes", seconds: Tensor, error: Tensor, color: str, name: str
) -> None:
    error = error.nan_to_num(nan=torch.inf)
    low, high = (error.quantile(q, 0) for q in SPREAD)
    axes.fill_between(seconds, low, high, color=color, alpha=0.15, lw=0)
    axes.plot(seconds, error.mean(0), color=color, label=name)


def _both(
    axes: "Axes", seconds: Tensor, lines: Mapping[str, Tensor], label: str
) -> None:
    for number, (name, line) in enumerate(lines.items()):
        axes.plot(
            seconds, line, STYLES[1 - number], color=COLORS[1 - number], label=name
        )
    axes.set_ylabel(label)
    axes.legend(frameon=False, fontsize=8, ncols=2)


def read_log(folder: Path) -> dict[str, list[float]]:
    """Columns of the ``log.csv`` of a training run.

    Raises:
        ValueError: none there, or nothing in it yet.
    """
    path = folder / "log.csv"
    if not path.is_file():
        raise ValueError(f"expected a training run with a log.csv in {folder}")
    with open(path, newline="") as file:
        rows = list(csv.DictReader(file))
    if not rows or "step" not in rows[0]:
        raise ValueError(f"expected rows with a step in {path}, found none")
    try:
        return {name: [float(row[name]) for row in rows] for name in rows[0]}
    except (TypeError, ValueError):
        raise ValueError(f"expected numbers in {path}, got something else") from None


def plot_training(folder: Path, path: Path) -> dict[str, list[float]]:
    """Loss and validation errors of a run, on logarithmic axes; returns the columns.

    Args:
        folder: of the run.
        path: of the PNG.

    Raises:
        ValueError: see `read_log`.
    """
    log = read_log(folder)
    errors = [name for name in log if name not in ("step", "loss")]
    figure, axes = make_figure(1 + bool(errors), PANEL * 2.4)
    axes[0].plot(log["step"], log["loss"], color=COLORS[0])
    axes[0].set(ylabel="loss", yscale="log")
    for number, name in enumerate(errors):
        color = SEVERAL[number % len(SEVERAL)]
        axes[1].plot(log["step"], log[name], color=color, label=name.replace("_", " "))
    if errors:
        axes[1].set(ylabel="validation error (m, rad)", yscale="log")
        axes[1].legend(frameon=False, fontsize=8, ncols=3)
    axes[-1].set_xlabel("updates")
    save_figure(figure, path)
    return log
