"""Drawings of a robot by matplotlib: no OpenGL, no display, no perspective."""

from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor

from torchrl_nerd.evaluation.plots import need_matplotlib
from torchrl_nerd.evaluation.render.camera import Camera
from torchrl_nerd.evaluation.render.outline import grid, patches, profile
from torchrl_nerd.evaluation.render.poser import Poser
from torchrl_nerd.evaluation.render.style import BONE, GHOST, PAPER, grid_spacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes

DPI = 100
FAR = 10.0  # heights of the picture


class DrawingRenderer:
    """Filled outlines, far ones first, over lines on the ground.

    Height fields are not drawn.

    Args:
        poser: of the robot.
        camera: from where.
        size: width and height of the picture, pixels.
    """

    name = "matplotlib, without OpenGL"

    def __init__(self, poser: Poser, camera: Camera, size: tuple[int, int]) -> None:
        need_matplotlib()
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        self.poser, self.camera = poser, camera
        width, height = size
        figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI, facecolor=PAPER)
        self._canvas = FigureCanvasAgg(figure)
        self._axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        self._half = camera.half_height * np.array((width / height, 1.0))

    def frame(
        self, number: int, qpos: Tensor, ghost: Tensor | None = None
    ) -> np.ndarray:
        """Picture ``(height, width, 3)``, uint8.

        Args:
            number: of the frame, which tells where the camera looks.
            qpos: ``(nq,)``.
            ghost: a second state of the robot, drawn faintly behind it.
        """
        axes, (right, up) = self._axes, self._half
        axes.clear()
        axes.set_axis_off()
        self._ground(axes, number, qpos)
        if ghost is not None:
            self._robot(axes, number, ghost, is_ghost=True)
        self._robot(axes, number, qpos)
        axes.set(xlim=(-right, right), ylim=(-up, up))
        self._canvas.draw()
        return np.asarray(self._canvas.buffer_rgba())[..., :3].copy()

    def close(self) -> None:
        """Nothing is held."""

    def _ground(self, axes: "Axes", number: int, qpos: Tensor) -> None:
        from matplotlib.collections import LineCollection

        data, camera = self.poser.pose(qpos), self.camera
        for plane in self.poser.planes:
            line = profile(data, plane, camera, number) if camera.is_side else None
            if line is not None:
                x, y = line.T
                axes.fill_between(x, y, -FAR * camera.half_height, color="0.93")
                axes.plot(x, y, color="0.5", lw=1.0)
                continue
            lines = grid(data, plane, camera.lookat[number], grid_spacing(camera))
            flat = list(camera.project(lines, number))
            look: dict[str, Any] = {"colors": "0.86", "linewidths": 0.8, "zorder": 0}
            axes.add_collection(LineCollection(flat, **look))

    def _robot(
        self, axes: "Axes", number: int, qpos: Tensor, is_ghost: bool = False
    ) -> None:
        from matplotlib.collections import LineCollection, PolyCollection

        poser, camera = self.poser, self.camera
        data = poser.pose(qpos)
        bones = list(camera.project(poser.bones(), number))
        look: dict[str, Any] = {
            "colors": [GHOST if is_ghost else BONE],
            "linewidths": 2.0,
        }
        axes.add_collection(LineCollection(bones, **look, zorder=1))
        geoms = sorted(
            poser.moving if is_ghost else poser.shapes,
            key=lambda geom: -camera.depth(data.geom_xpos[geom], number),
        )
        shapes, faces = [], []
        for geom in geoms:
            color = np.array(GHOST) if is_ghost else poser.colors[geom]
            for corners, light in patches(poser.model, data, geom, camera, number):
                shapes.append(corners)
                faces.append((*(light * color[:3]), color[3]))
        colors = np.array(faces).reshape(-1, 4)
        edges = 0.6 * colors[:, :3] if not is_ghost else [(*GHOST[:3], 0.9)]
        look = {"facecolors": colors, "edgecolors": edges, "linewidths": 0.8}
        axes.add_collection(PolyCollection(shapes, **look, zorder=1))
