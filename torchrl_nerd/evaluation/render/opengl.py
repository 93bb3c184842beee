"""The OpenGL library that draws on this machine, with or without a screen.

MuJoCo chooses its OpenGL library from ``MUJOCO_GL`` when it is first imported, and without
that variable takes one that needs a screen. `find_gl` tries the libraries in a child
process, because a broken driver can end the process.
"""

import os
import platform
import subprocess
import sys
from functools import cache
from importlib import import_module
from typing import Any

import mujoco

LIBRARIES = {"Darwin": ("cgl",), "Windows": ("glfw",)}
LINUX = ("egl", "osmesa", "glfw")
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
    names = (asked,) if asked else LIBRARIES.get(platform.system(), LINUX)
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


def make_renderer(model: mujoco.MjModel, width: int, height: int) -> Any:
    """A `mujoco.Renderer` of ``width`` by ``height`` pixels; see `require_gl`."""
    from mujoco.rendering.classic import gl_context

    # MuJoCo made its own choice when it was imported, see above.
    gl_context.GLContext = import_module(f"mujoco.{require_gl()}").GLContext
    return mujoco.Renderer(model, height, width)
