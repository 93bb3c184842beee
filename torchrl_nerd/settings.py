"""Settings of a configuration class that are out of range."""

from collections.abc import Iterable, Mapping, Sequence
from difflib import get_close_matches
from math import inf
from numbers import Integral
from typing import TypeVar

import torch

Value = TypeVar("Value")


class SettingError(ValueError):
    """Says in one sentence which setting was given and what was expected."""


def expect_at_least(least: float, **settings: float) -> None:
    """Raise a SettingError that names the first setting below ``least``."""
    for name, value in settings.items():
        if not least <= value < inf:  # NaN is not either
            raise SettingError(f"expected {name} of at least {least}, got {value}")


def expect_above_zero(**settings: float) -> None:
    """Raise a SettingError that names the first setting that is not above zero."""
    for name, value in settings.items():
        if not 0.0 < value < inf:
            raise SettingError(f"expected {name} above 0, got {value}")


def expect_share(**settings: float) -> None:
    """Raise a SettingError that names the first setting outside [0, 1]."""
    for name, value in settings.items():
        if not 0.0 <= value <= 1.0:
            raise SettingError(f"expected {name} from 0 to 1, got {value}")


def expect_count(least: int, **settings: object) -> None:
    """Raise a SettingError for what is no whole number of at least ``least``."""
    for name, value in settings.items():
        is_number = isinstance(value, Integral) and not isinstance(value, bool)
        if not is_number or int(value) < least:  # pyright: ignore
            raise SettingError(
                f"expected {name}, a whole number of at least {least}, got {value!r}"
            )


def expect_same(
    place: str, kept: Mapping[str, object], asked: Mapping[str, object], group: str = ""
) -> None:
    """Refuse to go on in a folder that holds what other settings made.

    Raises:
        ValueError: naming the first of those asked for that is another one in ``kept``,
            such as ``config.steps`` inside of a mapping.
    """
    for name, value in asked.items():
        other = kept.get(name)
        if other == value:
            continue
        if isinstance(value, Mapping) and isinstance(other, Mapping):
            expect_same(place, other, value, f"{group}{name}.")
        raise ValueError(
            f"{place} with {group}{name} {other}, asked for {value}: choose another "
            "folder"
        )


def did_you_mean(name: str, known: Iterable[str], first: Sequence[str] = ()) -> str:
    """`` (did you mean 'ant'?)``: the first of ``first``, or the nearest; or nothing."""
    near = [*first, *get_close_matches(name, known, 1)]
    return f" (did you mean '{near[0]}'?)" if near else ""


def look_up(what: str, name: str, known: Mapping[str, Value]) -> Value:
    """The entry of that name, or a SettingError that lists those that there are."""
    if name not in known:
        names = ", ".join(known)
        raise SettingError(f"unknown {what} '{name}', expected one of {names}")
    return known[name]


def expect_device(name: str, dtype: torch.dtype = torch.float64) -> torch.device:
    """The device of that name: ``cpu``, ``cuda``, or ``cuda:1`` for the second of several.

    ``dtype``: of the numbers that it has to compute with; ``mps`` has no float64.

    Raises:
        SettingError: naming the devices that this machine has, if it is none of them.
    """
    name = "cpu" if name == "cpu:0" else name  # there is one, by both names
    count = torch.cuda.device_count()
    found = ["cpu", *["cuda"][:count], *(f"cuda:{index}" for index in range(count))]
    if dtype != torch.float64 and torch.backends.mps.is_available():
        found.append("mps")
    if name not in found:
        raise SettingError(
            f"expected a device that torch finds here ({', '.join(found)}), got '{name}'"
        )
    return torch.device(name)
