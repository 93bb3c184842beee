"""Images of a robot by `mujoco.Renderer`, with or without a screen.

MuJoCo chooses its OpenGL library from ``MUJOCO_GL`` when it is first imported, and without
that variable takes one that needs a screen. `find_gl` tries the libraries in a child
process, because a broken driver can end the process.
"""

import copy
import os
import platform
import subprocess
import sys
from functools import cache
from importlib import import_module

import mujoco
import numpy as np
from mujoco.rendering.classic import gl_context
from torch import Tensor

from torchrl_nerd.scenes import Scene

LIBRARIES = {
    "Linux": ("egl", "osmesa", "glfw"),
    "Darwin": ("cgl",),
    "Windows": ("glfw",),
}
MARGIN = 1.25  # room around a robot that the camera follows
PROBE = """
import mujoco
model = mujoco.MjModel.from_xml_string("<mujoco/>")
renderer = mujoco.Renderer(model, 8, 8)
renderer.update_scene(mujoco.MjData(model))
renderer.render()
renderer.close()
print("rendered", flush=True)
"""


def find_gl() -> str | None:
    """The first OpenGL library that works here, such as ``"egl"``, or None.

    If ``MUJOCO_GL`` is set, only the library that it names is tried.
    """
    asked = os.environ.get("MUJOCO_GL", "").lower()
    names = (asked,) if asked else LIBRARIES[platform.system()]
    return next((name for name in names if _renders(name)), None)


@cache
def _renders(name: str) -> bool:
    env = {**os.environ, "MUJOCO_GL": name}
    done = subprocess.run([sys.executable, "-c", PROBE], env=env, capture_output=True)
    return b"rendered" in done.stdout


def require_gl() -> str:
    """The library of `find_gl`.

    Raises:
        ValueError: none works; what to install.
    """
    name = find_gl()
    if name is None:
        raise ValueError(
            "expected an OpenGL library for rendering, but none works on this machine: "
            "install libegl1 and libgl1-mesa-dri, or libosmesa6"
        )
    return name


class RobotRenderer:
    """Images of one robot on its terrain.

    The camera has the direction and the distance of MuJoCo's default free camera, which
    ``<visual><global azimuth= elevation=>`` and ``<statistic center= extent=>`` of the MJCF
    file set. It follows the center of mass of a floating base.

    Args:
        scene: the robot.
        width: of the image, pixels.
        height: of the image, pixels.
        terrain: ``(terrain.size,)`` where the terrain varies from env to env.

    Raises:
        ValueError: no OpenGL library works on this machine.
    """

    def __init__(
        self, scene: Scene, width: int, height: int, terrain: Tensor | None = None
    ) -> None:
        self.base, self.model = scene.base, copy.copy(scene.model)
        self.data, self.camera = mujoco.MjData(self.model), mujoco.MjvCamera()
        buffer = self.model.vis.global_
        buffer.offwidth, buffer.offheight = width, height
        mujoco.mjv_defaultFreeCamera(self.model, self.camera)
        if scene.base.is_floating:
            self.camera.distance *= MARGIN
        self.model.vis.quality.shadowsize = 1024  # less work for a CPU
        # in a small scene the ground would cast shadows on itself
        self.model.stat.extent = max(self.model.stat.extent, 1.0)
        ground = scene.terrain
        if terrain is not None and ground is not None and ground.is_per_row:
            pose, size = ground.mocap_pose(terrain).numpy(), 3 * self.model.nmocap
            self.data.mocap_pos.flat = pose[:size]
            self.data.mocap_quat.flat = pose[size:]
        # MuJoCo made its own choice when it was imported, see above
        gl_context.GLContext = import_module(f"mujoco.{require_gl()}").GLContext
        self._renderer = mujoco.Renderer(self.model, height, width)

    def render(self, qpos: Tensor) -> np.ndarray:
        """Image ``(height, width, 3)``, uint8, of the robot at ``qpos (nq,)``."""
        self.data.qpos[:] = qpos.numpy()
        mujoco.mj_fwdPosition(self.model, self.data)
        if self.base.is_floating:
            self.camera.lookat[:] = self.data.subtree_com[self.base.body]
        self._renderer.update_scene(self.data, self.camera)
        return self._renderer.render()

    def close(self) -> None:
        """Free the OpenGL context."""
        self._renderer.close()
