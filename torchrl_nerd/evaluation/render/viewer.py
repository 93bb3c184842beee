"""Learned motion in MuJoCo's own window, the true one as a grey ghost."""

import os
import sys
import time

from torchrl_nerd.evaluation.render.ghost import add_ghost
from torchrl_nerd.evaluation.render.pair import Pair
from torchrl_nerd.evaluation.render.poser import Poser

SCREENS = ("DISPLAY", "WAYLAND_DISPLAY")


def check_display() -> None:
    """Say where there is no screen.

    Raises:
        ValueError: none.
    """
    if sys.platform == "linux" and not any(os.environ.get(name) for name in SCREENS):
        raise ValueError(
            "the viewer needs a display, found none: leave out --viewer and "
            "give --out FILE.gif"
        )


def view(pair: Pair, slow: float = 1.0) -> None:
    """Play a pair again and again until the window is closed.

    Args:
        pair: what was played.
        slow: times slower than life.

    Raises:
        ValueError: no display.
    """
    check_display()
    from mujoco import viewer

    robot, ghost = (Poser(pair.scene, pair.terrain) for _ in range(2))
    with viewer.launch_passive(robot.model, robot.data) as window:
        while window.is_running():
            for learned, truth in zip(pair.learned, pair.truth, strict=True):
                if not window.is_running():
                    return
                began = time.perf_counter()
                with window.lock():
                    robot.pose(learned)
                    window.user_scn.ngeom = 0
                    add_ghost(ghost, truth, window.user_scn)
                window.sync()
                left = slow * pair.step_size - (time.perf_counter() - began)
                time.sleep(max(left, 0.0))
