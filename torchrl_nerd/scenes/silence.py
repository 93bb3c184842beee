"""MuJoCo without words: what it gives up on is reported by whoever asked."""

from collections.abc import Iterator
from contextlib import contextmanager

import mujoco


@contextmanager
def silence_mujoco() -> Iterator[None]:
    """Neither warnings on the terminal nor a MUJOCO_LOG.TXT in the working folder."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(_say_nothing)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)


def _say_nothing(message: str) -> None:
    pass
