"""One toss as it was measured and as models see it: side view, height, angle."""

from collections.abc import Mapping
from pathlib import Path

import torch
from matplotlib.figure import Figure
from torch import Tensor

from torchrl_nerd.geometry.rotations import orientation_error, rotate
from torchrl_nerd.robots.cube.scene import HALF

COLORS, STYLES = ("#0072B2", "#D55E00", "#009E73", "#CC79A7"), ("-", "--", ":", "-.")
OUTLINES = 5  # cubes drawn along the measured path
FACE = ((-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1))


def plot_toss(
    measured: Tensor, paths: Mapping[str, Tensor], step_size: float, path: Path
) -> None:
    """Write a PNG.

    Args:
        measured: poses ``(steps + 1, 7)``, the start first.
        paths: the same by name of the model, at most four.
        step_size: time between poses, s.
        path: of the PNG.
    """
    figure = Figure(figsize=(8.0, 7.0), layout="constrained")
    panels = figure.subplots(3, 1, height_ratios=(2.0, 1.2, 1.2))
    side, height, angle = panels
    along = measured[-1, :2] - measured[0, :2]
    along = along / torch.linalg.vector_norm(along).clamp_min(1e-9)
    time = step_size * torch.arange(len(measured))

    def travelled(poses: Tensor) -> Tensor:
        return (poses[..., :2] - measured[0, :2]) @ along

    side.plot(
        travelled(measured), measured[:, 2], color="0.2", lw=2.5, label="measured"
    )
    height.plot(time, measured[:, 2], color="0.2", lw=2.5)
    turned = orientation_error(
        measured[:1, 3:].expand(len(measured), 4), measured[:, 3:]
    )
    angle.plot(time, turned, color="0.2", lw=2.5)
    picks = torch.linspace(0, len(measured) - 1, OUTLINES).long()
    _outline(side, measured[picks], measured[0, :2], along, "0.6")
    for number, (name, poses) in enumerate(paths.items()):
        look = {"color": COLORS[number], "ls": STYLES[number], "lw": 1.6}
        side.plot(travelled(poses), poses[:, 2], **look, label=name)
        _outline(side, poses[-1:], measured[0, :2], along, COLORS[number])
        height.plot(time, poses[:, 2], **look)
        start = measured[:1, 3:].expand(len(poses), 4)
        angle.plot(time, orientation_error(start, poses[:, 3:]), **look)
    side.set(xlabel="along the toss (m)", ylabel="height (m)", aspect="equal")
    side.axhline(0.0, color="0.4", lw=0.8)
    side.legend(frameon=False, loc="upper right")
    height.set_ylabel("height (m)")
    angle.set(xlabel="time (s)", ylabel="turned since start (rad)")
    for panel in panels:
        panel.spines[["top", "right"]].set_visible(False)
        panel.grid(alpha=0.3)
    figure.savefig(path, dpi=150)


def _outline(panel, poses: Tensor, origin: Tensor, along: Tensor, color: str) -> None:  # noqa: ANN001
    """Edges of cubes, seen from the side."""
    corners = []
    for axis in range(3):
        for end in (-1.0, 1.0):
            loop = torch.zeros(len(FACE), 3, dtype=poses.dtype)
            others = [i for i in range(3) if i != axis]
            loop[:, others] = torch.tensor(FACE).to(poses)
            loop[:, axis] = end
            corners.append(HALF * loop)
    for pose in poses:
        for loop in corners:
            points = pose[:3] + rotate(pose[3:].expand(len(loop), 4), loop)
            x = (points[:, :2] - origin) @ along
            panel.plot(x, points[:, 2], color=color, lw=0.6, alpha=0.7)
