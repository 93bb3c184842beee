"""Figures of learned dynamics against the ground truth, written as PNG.

matplotlib is imported on first use: only `pip install torchrl-nerd[examples]` brings it.
"""

from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from torchrl_nerd.evaluation.rollout_error import unit_of
from torchrl_nerd.evaluation.traces import Traces
from torchrl_nerd.files import write_atomically

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# The colors of Okabe and Ito are told apart by every eye: https://jfly.uni-koeln.de/color/
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#999999")
STYLES = ("-", "--", ":", "-.")
WIDTH, PANEL_HEIGHT = 7.0, 2.2  # inches
BAND = (0.05, 0.95)  # quantiles


def plot_learning_curve(curve: Sequence[Mapping[str, float]], path: Path) -> None:
    """Mean return over training as PNG.

    Args:
        curve: points: ``frames`` (env steps) and the mean return by name of the dynamics
            it was measured in.
        path: of the PNG.
    """
    figure, (axes,) = make_figure(1, height=4.0)
    millions = [point["frames"] / 1e6 for point in curve]
    names = list(curve[0])
    for number, name in enumerate(names[1:]):
        returns = [point[name] for point in curve]
        axes.plot(millions, returns, STYLES[number], color=COLORS[number], label=name)
    axes.set(
        xlabel="environment steps (millions)", ylabel="mean return (higher: better)"
    )
    axes.set_title("Return of the policy over training", fontsize=10, loc="left")
    axes.legend(frameon=False)
    save_figure(figure, path)


def plot_traces(traces: Traces, names: Sequence[str], title: str, path: Path) -> None:
    """Errors of all trajectories over time, and energy and distance of one, as PNG.

    Args:
        traces: of `compare_traces`.
        names: of the two dynamics.
        title: of the figure.
        path: of the PNG.
    """
    units = {name: unit_of(traces.scene, name) for name in traces.errors}
    kinds = list(dict.fromkeys(units.values()))
    panels = len(kinds) + 1 + (traces.distances is not None)
    figure, axes = make_figure(panels, PANEL_HEIGHT * panels)
    figure.suptitle(title, fontsize=11)
    count = len(next(iter(traces.errors.values())))
    what = (
        f"Error over {count} trajectories: mean and 5% to 95% (lower is better \u2193)"
    )
    for panel, unit in zip(axes, kinds, strict=False):
        quantities = [name for name in units if units[name] == unit]
        for color, name in zip(COLORS * len(quantities), quantities, strict=False):
            error = traces.errors[name].nan_to_num(nan=float("inf"))
            low, high = (error.quantile(q, 0) for q in BAND)
            panel.fill_between(traces.seconds, low, high, color=color, alpha=0.15, lw=0)
            label = name.replace("_", " ")
            panel.plot(traces.seconds, error.mean(0), color=color, label=label)
        panel.set_ylim(bottom=0.0)
        _annotate(panel, what, f"error ({unit})")
    lines = [("Energy", "energy (J)", traces.energies)]
    if traces.distances is not None:
        lines.append(("Distance to the terrain", "distance (m)", traces.distances))
    for panel, (what, label, both) in zip(axes[len(kinds) :], lines, strict=True):
        for i in (1, 0):
            (line,) = panel.plot(traces.seconds, both[i], STYLES[1 - i], label=names[i])
            line.set_color(COLORS[i])
        _annotate(panel, f"{what}, trajectory of median error", label)
    axes[-1].set_xlabel("time (s)")
    save_figure(figure, path)


def _annotate(axes: "Axes", title: str, label: str) -> None:
    axes.set_title(title, fontsize=9, loc="left")
    axes.set_ylabel(label)
    axes.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1, 0.5))


def make_figure(
    panels: int, height: float, share_x: bool = True
) -> "tuple[Figure, list[Axes]]":
    """Stacked panels ``height`` inches high together; no display is needed.

    Raises:
        ModuleNotFoundError: matplotlib is not installed.
    """
    if find_spec("matplotlib") is None:
        raise ModuleNotFoundError(
            "figures need matplotlib: pip install 'torchrl-nerd[examples]'"
        )
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(panels, 1, sharex=share_x, squeeze=False)[:, 0]
    for panel in axes:
        panel.spines[["top", "right"]].set_visible(False)
        panel.grid(alpha=0.3)
    return figure, list(axes)


def save_figure(figure: "Figure", path: Path) -> None:
    """Write a PNG, whole or not at all."""
    write_atomically(path, lambda aside: figure.savefig(aside, format="png", dpi=150))
