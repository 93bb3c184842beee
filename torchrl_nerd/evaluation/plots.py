"""Figures of learned against true dynamics, written as PNG.

matplotlib is imported on first use: only `pip install torchrl-nerd[examples]` brings it.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from mujoco import mjtJoint
from torch import Tensor

from torchrl_nerd.files import write_atomically
from torchrl_nerd.scenes import Scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's colours tell apart for every eye: https://jfly.uni-koeln.de/color/
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")
PARTS = {  # of a joint's qpos
    mjtJoint.mjJNT_FREE: ("x (m)", "y (m)", "z (m)", "qw", "qx", "qy", "qz"),
    mjtJoint.mjJNT_BALL: ("qw", "qx", "qy", "qz"),
    mjtJoint.mjJNT_SLIDE: ("(m)",),
    mjtJoint.mjJNT_HINGE: ("(rad)",),
}
STYLES = ("-", "--", ":", "-.")
PANEL = (7.0, 2.0)  # inches


def plot_learning_curve(
    frames: Sequence[int], returns: Mapping[str, Sequence[float]], path: Path
) -> None:
    """Mean return over training.

    Args:
        frames: env steps at each point.
        returns: mean return at each point, by name of the dynamics it was measured in.
        path: of the PNG.
    """
    figure, (axes,) = _figure(1, height=4.0)
    for number, (name, values) in enumerate(returns.items()):
        millions = [count / 1e6 for count in frames]
        axes.plot(millions, values, STYLES[number % 4], color=COLORS[number % 4], label=name)
    axes.set(xlabel="env steps (millions)", ylabel="mean return")
    axes.legend(frameon=False)
    _save(figure, path)


def plot_states(
    states: Mapping[str, Tensor], names: Sequence[str], control_step: float, path: Path
) -> None:
    """One panel per state coordinate, one line per dynamics.

    Args:
        states: ``(steps, len(names))`` each, by name of the dynamics; lengths may differ.
        names: of the coordinates, with units.
        control_step: s.
        path: of the PNG.
    """
    figure, panels = _figure(len(names), height=PANEL[1] * len(names))
    for coordinate, (axes, label) in enumerate(zip(panels, names, strict=True)):
        for number, (name, values) in enumerate(states.items()):
            seconds = [control_step * (step + 1) for step in range(len(values))]
            y = values[:, coordinate].tolist()
            axes.plot(seconds, y, STYLES[number % 4], color=COLORS[number % 4], label=name)
        axes.set_ylabel(label)
    panels[-1].set_xlabel("time (s)")
    panels[0].legend(frameon=False, ncols=len(states))
    _save(figure, path)


def qpos_names(scene: Scene) -> list[str]:
    """Name and unit of every entry of ``qpos``, for `plot_states`."""
    model, names = scene.model, []
    for joint in range(model.njnt):
        name = model.joint(joint).name
        names += [f"{name} {part}".strip() for part in PARTS[model.jnt_type[joint]]]
    return names


def _figure(panels: int, height: float) -> "tuple[Figure, list[Axes]]":
    """Stacked panels that share the horizontal axis; no display is needed."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ModuleNotFoundError:
        raise ModuleNotFoundError(
            "figures need matplotlib: pip install 'torchrl-nerd[examples]'"
        ) from None
    figure = Figure(figsize=(PANEL[0], height), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(panels, 1, sharex=True, squeeze=False)[:, 0]
    for panel in axes:
        panel.spines[["top", "right"]].set_visible(False)
        panel.grid(alpha=0.3)
    return figure, list(axes)


def _save(figure: "Figure", path: Path) -> None:
    write_atomically(path, lambda aside: figure.savefig(aside, format="png", dpi=150))
