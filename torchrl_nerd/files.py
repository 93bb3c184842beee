"""Files that are either whole or not there: written aside, flushed, renamed."""

import glob
import json
import os
import re
import tempfile
from collections.abc import Callable
from errno import EEXIST, EISDIR
from math import isfinite
from pathlib import Path
from threading import get_ident
from typing import Any


def write_atomically(path: Path, write: Callable[[Path], object]) -> None:
    """Replace ``path`` by what ``write(temporary path)`` leaves, durably.

    A crash at any moment leaves the old file or the new one, never a part; what it left
    aside is removed by the next write. A link stays: the file that it leads to is written.

    Raises:
        ValueError: in one sentence, why it cannot be written.
    """
    try:
        _replace(path, write)
    except OSError as error:
        reason = error.strerror or error
        raise ValueError(f"{path} cannot be written: {reason}") from None


def _file_at(path: Path) -> Path:
    """Where a file of that path is, or would be; an OSError where it is something else."""
    if path.is_dir():
        raise IsADirectoryError(EISDIR, os.strerror(EISDIR))
    if path.exists() and not path.is_file():
        raise OSError(EEXIST, "expected a regular file there, got a pipe or a device")
    return Path(os.path.realpath(path))


def _replace(path: Path, write: Callable[[Path], object]) -> None:
    path = _file_at(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    for left in path.parent.glob(f".{glob.escape(path.name)}.*.tmp"):
        if not _is_running(left.suffixes[-2]):
            left.unlink(missing_ok=True)
    aside = path.with_name(f".{path.name}.{get_ident()}.{os.getpid()}.tmp")
    try:
        write(aside)
        with open(aside, "rb+") as file:
            os.fsync(file.fileno())
        os.replace(aside, path)
    finally:
        aside.unlink(missing_ok=True)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def _is_running(process: str) -> bool:
    """Whether a process of that number, ``.123``, may still write."""
    try:
        os.kill(int(process[1:]), 0)
    except (ProcessLookupError, ValueError, OverflowError):
        return False
    except PermissionError:  # of another user
        return True
    return True


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a JSON object atomically; non-finite numbers become null, paths strings."""
    text = json.dumps(_plain(content), indent=2, allow_nan=False) + "\n"
    write_atomically(path, lambda aside: aside.write_text(text))


def _plain(content: Any) -> Any:
    if isinstance(content, dict):
        return {key: _plain(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [_plain(value) for value in content]
    if isinstance(content, Path):
        return str(content)
    is_odd = isinstance(content, float) and not isfinite(content)
    return None if is_odd else content


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object; a ValueError where the file holds something else."""
    if not path.is_file():  # a device would be read without end
        raise ValueError(f"expected JSON in {path}, found no file")
    try:
        content = json.loads(path.read_text())
    except (ValueError, RecursionError) as error:
        said = f"expected JSON in {path}, got something else: {error}"
        raise ValueError(said) from None
    if not isinstance(content, dict):
        kind = type(content).__name__
        raise ValueError(f"expected a JSON object in {path}, got a {kind}")
    return content


def check_writable(path: Path) -> None:
    """Raise a ValueError where a file cannot be written; nothing is made or changed."""
    try:
        folders = _file_at(path).parents
        there = next(folder for folder in folders if folder.exists())
        tempfile.TemporaryFile(dir=there).close()
    except OSError as error:
        raise ValueError(f"{path} cannot be written: {error.strerror}") from None


def writable_folder(path: Path) -> Path:
    """Create a folder, or raise a ValueError that says why it cannot be written."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=path).close()
    except OSError as error:
        raise ValueError(
            f"expected a folder that can be written, got {path}: {error.strerror}"
        ) from None
    return path


def folder_name(name: str) -> str:
    """A scene's name as that of one folder: ``dm_control-cheetah-run``.

    Whatever is no letter, digit, dot, dash or underscore becomes a dash, and none leads, so
    that no name leads out of the folder it is put in; an MJCF file loses its ending.
    """
    safe = re.sub(r"[^\w.-]+", "-", name.removesuffix(".xml")).strip("-.")
    return safe or "robot"
