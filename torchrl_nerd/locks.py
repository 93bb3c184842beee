"""Locks that are free in a child process, whoever held them when it was forked."""

import os
from threading import RLock


def fork_safe_lock() -> RLock:
    """A lock that threads share; a fork waits for it, so its child gets it unlocked."""
    lock = RLock()
    if hasattr(os, "register_at_fork"):  # not on Windows
        os.register_at_fork(
            before=lock.acquire,
            after_in_parent=lock.release,
            after_in_child=lock.release,
        )
    return lock
