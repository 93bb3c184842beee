"""Help texts for people: what to type in place of types, and no marks of Markdown."""

import re
from pathlib import Path
from types import NoneType, UnionType
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
    is_union = get_origin(info.type) in (Union, UnionType)
    parts: tuple[Any, ...] = get_args(info.type) if is_union else (info.type,)
    kind, *others = [part for part in parts if part is not NoneType] or [NoneType]
    known: tuple[str, ...] = get_args(kind) if get_origin(kind) is Literal else ()
    if others or not (known or kind in METAVARS):
        return None

    def fits(x: Any) -> bool:
        if x is None:
            return NoneType in parts
        return x in known if known else isinstance(x, kind)

    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="{" + ",".join(known) + "}" if known else METAVARS[kind],
        instance_from_str=lambda words: words[0] if known else kind(words[0]),
        is_instance=fits,
        str_from_instance=lambda x: ["none" if x is None else str(x)],
        choices=known or None,
    )


def tidy(text: str) -> str:
    """Help without empty defaults, and with quotes for backticks."""
    lines = NO_DEFAULT.sub("", text).replace("`", "'").splitlines()
    return "".join(f"{line.rstrip()}\n" for line in lines)
