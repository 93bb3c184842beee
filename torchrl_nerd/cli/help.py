"""Help texts for people: what to type in place of types, and no marks of Markdown."""

import re
from collections.abc import Callable
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin

from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
)

METAVARS: dict[Any, str] = {str: "NAME", Path: "PATH", int: "N", float: "X"}
REGISTRY = ConstructorRegistry()
"""How options are read and named; a context manager round `tyro.cli`."""
NO_DEFAULT = re.compile(r"\s*\(default:\s*(none)?\)")


@REGISTRY.primitive_rule
def read_option(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
    """An option of a plain type, or of one that may be left out: ``PATH``."""
    kinds: tuple[Any, ...] = (info.type,)
    is_optional = False
    if get_origin(info.type) in (Union, UnionType):
        kinds = tuple(kind for kind in get_args(info.type) if kind is not type(None))
        is_optional = len(kinds) < len(get_args(info.type))
    if len(kinds) != 1:
        return None
    kind, choices = kinds[0], None
    make: Callable[[str], Any] = kind
    if get_origin(kind) is Literal and all(isinstance(x, str) for x in get_args(kind)):
        choices, make = get_args(kind), str
    elif kind not in METAVARS:
        return None
    known = choices or ()

    def fits(x: Any) -> bool:
        if x is None:
            return is_optional
        return x in known if known else isinstance(x, kind)

    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="{" + ",".join(known) + "}" if known else METAVARS[kind],
        instance_from_str=lambda words: make(words[0]),
        is_instance=fits,
        str_from_instance=lambda x: ["none" if x is None else str(x)],
        choices=choices,
    )


def tidy(text: str) -> str:
    """Help without empty defaults, and with quotes for backticks."""
    lines = NO_DEFAULT.sub("", text).replace("`", "'").splitlines()
    return "".join(f"{line.rstrip()}\n" for line in lines)
