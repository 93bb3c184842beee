"""MuJoCo's own renderer on a machine without a screen.

MUJOCO_GL is read when mujoco is first imported, long before anything is drawn, so no
variable is set here: the context is made by name and belongs to the renderer alone. Drivers
may end the process, so which name works is tried in another one.
"""

import os
import subprocess
import sys
from collections.abc import Mapping
from importlib import import_module
from typing import Any

import mujoco
import numpy as np
from torch import Tensor

from torchrl_nerd.evaluation.render.camera import FIELD_OF_VIEW, Camera
from torchrl_nerd.evaluation.render.ghost import add_ghost
from torchrl_nerd.evaluation.render.outline import grid
from torchrl_nerd.evaluation.render.poser import PLANE, Poser
from torchrl_nerd.evaluation.render.style import BONE, GROUND, PAPER, grid_spacing

HEADLESS = ("egl", "osmesa")
NONE = ("0", "disable", "disabled", "false", "no", "off")  # MuJoCo's words for it
PROBE_SECONDS = 60.0
PROBE = """
import sys
from importlib import import_module
import mujoco
context = import_module(f"mujoco.{sys.argv[1]}").GLContext(64, 64)
context.make_current()
model = mujoco.MjModel.from_xml_string("<mujoco/>")
mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
print("drawn", flush=True)
"""
MAX_GEOMS = 2000
LINE_WIDTH = 1.5  # pixels
LINE_COLOR = (0.7, 0.72, 0.7, 1.0)
BONE_WIDTH = 0.004  # of the distance
SHRINK = 0.99  # of every second shape, so that equal surfaces do not flicker
HAZE = (1.5, 4.0)  # where it begins and is full, in distances


def find_gl(environment: Mapping[str, str] = os.environ) -> str | None:
    """The first of egl and osmesa that draws on this machine, None where neither does.

    Args:
        environment: ``MUJOCO_GL`` in it leaves that one choice, or none at all.
    """
    asked = environment.get("MUJOCO_GL", "").lower()
    if asked in NONE:
        return None
    names = (asked,) if asked in HEADLESS else HEADLESS
    return next((name for name in names if _draws(name, environment)), None)


def _draws(name: str, environment: Mapping[str, str]) -> bool:
    command = [sys.executable, "-c", PROBE, name]
    env = {**environment, "MUJOCO_GL": name, "PYOPENGL_PLATFORM": name}
    try:
        done = subprocess.run(
            command, env=env, capture_output=True, text=True, timeout=PROBE_SECONDS
        )
    except subprocess.TimeoutExpired:
        return False
    return "drawn" in done.stdout


class OpenGLRenderer:
    """Frames by MuJoCo, with lines on the ground so that motion over it shows.

    Args:
        poser: of the robot.
        camera: from where.
        size: width and height of the picture, pixels.
        gl: egl or osmesa, as `find_gl` found it.
    """

    def __init__(
        self, poser: Poser, camera: Camera, size: tuple[int, int], gl: str
    ) -> None:
        self.name = f"MuJoCo on {gl}"
        self.poser, self.camera = poser, camera
        model = poser.model
        model.vis.global_.offwidth, model.vis.global_.offheight = size
        model.vis.global_.fovy = FIELD_OF_VIEW
        _soften(poser, camera)
        self._size = size
        self._gl: Any = import_module(f"mujoco.{gl}").GLContext(*size)
        self._gl.make_current()
        scale = mujoco.mjtFontScale.mjFONTSCALE_100.value
        self._context: Any = mujoco.MjrContext(model, scale)
        offscreen = mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value
        mujoco.mjr_setBuffer(offscreen, self._context)
        self._scene = mujoco.MjvScene(model, MAX_GEOMS)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_FOG] = True
        self._option, self._camera = mujoco.MjvOption(), mujoco.MjvCamera()
        self._camera.distance = camera.distance
        self._camera.azimuth, self._camera.elevation = camera.azimuth, camera.elevation

    def frame(
        self, number: int, qpos: Tensor, ghost: Tensor | None = None
    ) -> np.ndarray:
        """See `DrawingRenderer.frame`."""
        self._camera.lookat[:] = self.camera.lookat[number]
        data, scene = self.poser.pose(qpos), self._scene
        model, option, pert = self.poser.model, self._option, mujoco.MjvPerturb()
        mask = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(model, data, option, pert, self._camera, mask, scene)
        self._backdrop(number)
        spacing = grid_spacing(self.camera)
        for plane in self.poser.planes:
            lines = grid(data, plane, self.camera.lookat[number], spacing)
            self._connect(lines, mujoco.mjtGeom.mjGEOM_LINE, LINE_WIDTH, LINE_COLOR)
        thin = BONE_WIDTH * self.camera.distance
        self._connect(self.poser.bones(), mujoco.mjtGeom.mjGEOM_CAPSULE, thin, BONE)
        if ghost is not None:
            add_ghost(self.poser, ghost, scene)
        width, height = self._size
        view = mujoco.MjrRect(0, 0, width, height)
        mujoco.mjr_render(view, scene, self._context)
        pixels = np.empty((height, width, 3), np.uint8)
        mujoco.mjr_readPixels(pixels, None, view, self._context)
        return pixels[::-1]

    def _backdrop(self, number: int) -> None:
        """A wall behind everything, lost in the haze: MuJoCo's sky is black."""
        far, camera = 1.1 * HAZE[1] * self.camera.distance, self.camera
        geom = self._scene.geoms[self._scene.ngeom]
        centre = camera.lookat[number] + far * camera.axes[2]
        size, turn = np.array((4.0 * far, 4.0 * far, 0.01 * far)), camera.axes.T.ravel()
        white, kind = np.ones(4, np.float32), mujoco.mjtGeom.mjGEOM_BOX
        mujoco.mjv_initGeom(geom, kind, size, centre, turn, white)
        self._scene.ngeom += 1

    def _connect(
        self,
        lines: np.ndarray,
        kind: mujoco.mjtGeom,
        width: float,
        color: tuple[float, ...],
    ) -> None:
        """Add lines ``(n, 2, 3)`` to the scene, as far as there is room."""
        room = self._scene.maxgeom - self._scene.ngeom
        for start, end in lines[:room]:
            geom = self._scene.geoms[self._scene.ngeom]
            rgba, nothing = np.array(color, np.float32), np.zeros(3)
            mujoco.mjv_initGeom(geom, kind, nothing, nothing, np.zeros(9), rgba)
            mujoco.mjv_connector(geom, kind, width, start, end)
            self._scene.ngeom += 1

    def close(self) -> None:
        """Give the OpenGL context back."""
        self._context.free()
        self._gl.free()


def _soften(poser: Poser, camera: Camera) -> None:
    """Endless plain ground, haze in place of a black sky, light that does not blind."""
    model, planes = poser.model, poser.model.geom_type == PLANE
    model.geom_rgba[planes, 3] = 0.0  # walls
    model.geom_rgba[poser.planes], model.geom_matid[planes] = GROUND, -1
    model.geom_size[planes] = (0.0, 0.0, camera.half_height)  # endless; its mesh
    model.mat_reflectance[:] = 0.0
    model.geom_size[poser.shapes[::2]] *= SHRINK
    haze = model.vis.map
    haze.zfar = 10.0 * HAZE[1] * camera.distance / model.stat.extent
    haze.fogstart, haze.fogend = (x * camera.distance / model.stat.extent for x in HAZE)
    model.vis.rgba.fog = (*PAPER, 1.0)
    model.vis.rgba.haze = (*PAPER, 1.0)
    model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:] = 0.55, 0.35
    model.vis.headlight.specular[:] = 0.0
    model.light_diffuse[:], model.light_specular[:] = 0.3, 0.0
    model.vis.quality.shadowsize = 1024
