"""Figures of learned against true dynamics, written as PNG.

matplotlib is imported on first use: only `pip install torchrl-nerd[examples]` brings it.
"""

from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from mujoco import mjtJoint
from tensordict import TensorDictBase

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


def plot_learning_curve(curve: Sequence[Mapping[str, float]], path: Path) -> None:
    """Mean return over training, and beside it the numbers as CSV.

    Args:
        curve: points: ``frames`` (env steps) and the mean return by name of the dynamics
            it was measured in.
        path: of the PNG; the table's name ends in ``.csv`` instead.
    """
    figure, (axes,) = make_figure(1, height=4.0)
    millions = [point["frames"] / 1e6 for point in curve]
    names = list(curve[0])
    for number, name in enumerate(names[1:]):
        returns = [point[name] for point in curve]
        axes.plot(millions, returns, STYLES[number], color=COLORS[number], label=name)
    axes.set(xlabel="environment steps (millions)", ylabel="mean return")
    axes.legend(frameon=False)
    save_figure(figure, path)
    rows = [names, *([str(point[name]) for name in names] for point in curve)]
    text = "".join(",".join(row) + "\n" for row in rows)
    write_atomically(
        path.with_suffix(".csv"), lambda aside: aside.write_text(text) and None
    )


def plot_states(
    episodes: Mapping[str, TensorDictBase], scene: Scene, path: Path
) -> None:
    """Positions and reward over time, one panel each, one line per dynamics.

    Args:
        episodes: ``qpos`` and ``reward`` after each step, ``[steps]``, by name of the
            dynamics; lengths may differ.
        scene: the robot.
        path: of the PNG.
    """
    labels = [*qpos_names(scene), "reward"]
    figure, panels = make_figure(len(labels), height=PANEL[1] * len(labels))
    for number, (name, steps) in enumerate(episodes.items()):
        values = torch.cat((steps["qpos"], steps["reward"]), -1)
        seconds = scene.control_step * torch.arange(1, len(values) + 1)
        for axes, line in zip(panels, values.unbind(-1), strict=True):
            axes.plot(seconds, line, STYLES[number], color=COLORS[number], label=name)
    for axes, label in zip(panels, labels, strict=True):
        axes.set_ylabel(label)
    panels[-1].set_xlabel("time (s)")
    panels[0].legend(frameon=False, ncols=len(episodes))
    save_figure(figure, path)


def qpos_names(scene: Scene) -> list[str]:
    """Name and unit of every entry of ``qpos``."""
    model, names = scene.model, []
    for joint in range(model.njnt):
        name = model.joint(joint).name
        names += [f"{name} {part}" for part in PARTS[mjtJoint(model.jnt_type[joint])]]
    return names


def make_figure(
    panels: int, height: float, share_x: bool = True
) -> "tuple[Figure, list[Axes]]":
    """Stacked panels ``height`` inches high together; no display is needed."""
    need_matplotlib()
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(PANEL[0], height), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(panels, 1, sharex=share_x, squeeze=False)[:, 0]
    for panel in axes:
        panel.spines[["top", "right"]].set_visible(False)
        panel.grid(alpha=0.3)
    return figure, list(axes)


def need_matplotlib() -> None:
    """Say in one sentence where matplotlib (and its pillow) is missing.

    Raises:
        ModuleNotFoundError: it is.
    """
    if find_spec("matplotlib") is None:
        raise ModuleNotFoundError(
            "figures need matplotlib: pip install 'torchrl-nerd[examples]'"
        )


def save_figure(figure: "Figure", path: Path) -> None:
    """Write a PNG, whole or not at all."""
    write_atomically(path, lambda aside: figure.savefig(aside, format="png", dpi=150))
