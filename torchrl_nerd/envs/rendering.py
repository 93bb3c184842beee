"""Images of a task by `mujoco.Renderer`, with or without a screen.

MuJoCo chooses its OpenGL library from ``MUJOCO_GL`` when it is first imported, and without
that variable takes one that needs a screen. `find_gl` tries the libraries in a child
process, because a broken driver can end the process.
"""

import atexit
import copy
import os
import platform
import subprocess
import sys
from functools import cache, cached_property
from importlib import import_module
from threading import RLock
from typing import Any
from weakref import WeakSet

import mujoco
import numpy as np

from torchrl_nerd.dynamics.base import as_numpy, ground_pose
from torchrl_nerd.keys import GOAL, QPOS, TERRAIN
from torchrl_nerd.settings import expect_count
from torchrl_nerd.tasks import Task
from torchrl_nerd.tasks.task import State

LIBRARIES = {
    "Linux": ("egl", "osmesa", "glfw"),
    "Darwin": ("cgl",),
    "Windows": ("glfw",),
}
MARGIN = 1.25  # room around a robot that the camera follows
SMALL = 128  # pixels; lower images are drawn without shadows and smoothing
GOAL_RADIUS, GOAL_COLOR = 0.02, (0.9, 0.2, 0.2, 1.0)  # m
PROBE = """
import mujoco
model = mujoco.MjModel.from_xml_string("<mujoco/>")
renderer = mujoco.Renderer(model, 8, 8)
renderer.update_scene(mujoco.MjData(model))
renderer.render()
renderer.close()
print("rendered", flush=True)
"""

Camera = mujoco.MjvCamera | int | str


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
    """The library of `find_gl`, or a ValueError that says what to install."""
    name = find_gl()
    if name is None and (asked := os.environ.get("MUJOCO_GL")):
        raise ValueError(
            "expected MUJOCO_GL to name an OpenGL library that works on this machine, got "
            f"'{asked}': unset it, or install that library"
        )
    if name is None:
        raise ValueError(
            "expected an OpenGL library for rendering, but none works on this machine: "
            "install libegl1 and libgl1-mesa-dri, or libosmesa6"
        )
    return name


class Renderer:
    """Images of a task's robot on its terrain, with the goals of its state.

    What OpenGL needs is made at the first image and freed by `close`; a copy, or one in
    another process, makes its own. Threads may share a renderer: they take turns.

    The camera is the model's first one that stands in the world or tracks the robot.
    Without such a camera it is MuJoCo's default free camera, whose direction and distance
    ``<visual><global azimuth= elevation=>`` and ``<statistic center= extent=>`` of the MJCF
    file set; it follows the center of mass of a floating base. `Task.show` puts the task's
    own things into the image.
    """

    def __init__(self, task: Task) -> None:
        self.task = task
        self._gl: dict[tuple[int, int], mujoco.Renderer] = {}  # by height and width
        self._lock = RLock()  # a context is current in one thread at a time
        _ALL.add(self)

    def __reduce__(self) -> tuple[Any, ...]:
        """Without what is drawn with."""
        return type(self), (self.task,)

    @cached_property
    def _model(self) -> mujoco.MjModel:
        return copy.copy(self.task.scene.model)  # `Task.show` may change it

    @cached_property
    def _data(self) -> mujoco.MjData:
        return mujoco.MjData(self._model)

    def close(self) -> None:
        """Free the OpenGL contexts; the next image makes new ones."""
        with self._lock:
            while self._gl:
                _, renderer = self._gl.popitem()
                if renderer._gl_context:  # or nothing of it would be freed
                    renderer._gl_context.make_current()
                renderer.close()
                _release()

    def __del__(self) -> None:
        self.close()

    def __call__(
        self,
        state: State,
        height: int = 240,
        width: int = 320,
        camera_id: int | str | None = None,
    ) -> np.ndarray:
        """Images ``(n, height, width, 3)``, uint8; sizes are in pixels.

        Of a ``state`` with ``qpos (n, nq)`` and the task's parameters, by the camera of
        that number or name, -1 for the free one. Lower ones than `SMALL` are drawn without
        shadows and smoothing, which is faster.

        Raises:
            ValueError: no such camera, or no OpenGL library works on this machine.
        """
        expect_count(1, height=height, width=width)
        with self._lock:
            try:
                return self._images(state, height, width, camera_id)
            finally:
                _release()

    def _images(
        self, state: State, height: int, width: int, camera_id: int | str | None
    ) -> np.ndarray:
        camera = self._camera(camera_id)
        if (height, width) not in self._gl:
            self._gl[height, width] = self._make_gl(height, width)
        renderer = self._gl[height, width]
        images = np.empty((len(state[QPOS]), height, width, 3), np.uint8)
        for i, image in enumerate(images):
            shown = {key: value[i] for key, value in state.items()}
            self._draw(shown, renderer, camera)
            renderer.render(out=image)
        return images

    def _draw(self, shown: State, renderer: "mujoco.Renderer", camera: Camera) -> None:
        model, data, scene = self._model, self._data, self.task.scene
        data.qpos[:] = as_numpy(shown[QPOS])
        for key, value in ground_pose(scene, shown.get(TERRAIN)).items():
            getattr(data, key)[:] = as_numpy(value)
        self.task.show(model, data, shown)
        mujoco.mj_fwdPosition(model, data)
        if scene.base.is_floating and not isinstance(camera, int | str):
            camera.lookat[:] = data.subtree_com[scene.base.body]
        renderer.update_scene(data, camera)
        goal = shown.get(GOAL)
        if goal is not None and goal.shape[-1] == 3:  # a user's task may mean another
            seen = renderer.scene
            mujoco.mjv_initGeom(
                seen.geoms[seen.ngeom],
                mujoco.mjtGeom.mjGEOM_SPHERE,
                np.full(3, GOAL_RADIUS),
                as_numpy(goal),
                np.eye(3).ravel(),
                np.array(GOAL_COLOR, np.float32),
            )
            seen.ngeom += 1

    def _camera(self, camera_id: int | str | None) -> Camera:
        model, camera = self.task.scene.model, mujoco.MjvCamera()
        if camera_id is None:
            is_fixed = model.cam_mode == int(mujoco.mjtCamLight.mjCAMLIGHT_FIXED)
            stands = ~is_fixed | (model.cam_bodyid == 0)
            camera_id = int(np.argmax(stands)) if stands.any() else -1
        if camera_id != -1:
            return camera_id  # `mujoco.Renderer` knows its name or number
        mujoco.mjv_defaultFreeCamera(model, camera)
        if self.task.scene.base.is_floating:
            camera.distance *= MARGIN
        return camera

    def _make_gl(self, height: int, width: int) -> "mujoco.Renderer":
        if _DREW and _DREW[0] != os.getpid():  # drivers hang in it
            raise ValueError(
                "expected a process started with 'spawn': no image can be drawn in one "
                "that was forked from a process that had drawn some"
            )
        look = self._model.vis
        look.global_.offwidth, look.global_.offheight = width, height
        look.quality.shadowsize = 1024  # less work for a CPU
        look.quality.numslices, look.quality.numstacks = 16, 10
        look.quality.offsamples = 0 if height < SMALL else 4
        # in a small scene the ground would cast shadows on itself
        self._model.stat.extent = max(self._model.stat.extent, 1.0)
        # MuJoCo made its own choice when it was imported, see above
        # needs an OpenGL library, which envs that are not drawn do without
        gl_context = import_module("mujoco.rendering.classic.gl_context")
        library = import_module(f"mujoco.{require_gl()}")
        vars(gl_context)["GLContext"] = library.GLContext
        renderer = mujoco.Renderer(self._model, height, width)
        _DREW[:] = [os.getpid()]
        atexit.unregister(_close_all)  # before MuJoCo gives the display back
        atexit.register(_close_all)
        shadow = mujoco.mjtRndFlag.mjRND_SHADOW
        renderer.scene.flags[shadow] = height >= SMALL
        return renderer


_ALL: WeakSet[Renderer] = WeakSet()
_DREW: list[int] = []  # the process that drew
_OF_PARENT: "list[mujoco.Renderer]" = []
"""What a forked process got from its parent: it must neither draw with it nor free it."""


def _release() -> None:
    """Let other threads draw too."""
    if (egl := sys.modules.get("mujoco.egl")) is not None and egl.EGL_DISPLAY:
        none = egl.EGL.EGL_NO_SURFACE, egl.EGL.EGL_NO_SURFACE, egl.EGL.EGL_NO_CONTEXT
        egl.EGL.eglMakeCurrent(egl.EGL_DISPLAY, *none)


def _close_all() -> None:
    for renderer in _ALL:
        renderer.close()


def _disown() -> None:
    for renderer in _ALL:
        _OF_PARENT.extend(renderer._gl.values())
        renderer._gl, renderer._lock = {}, RLock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_disown)
