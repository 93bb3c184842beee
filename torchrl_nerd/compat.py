"""Private names of torch and tensordict, each with a public fallback."""

from collections.abc import Mapping
from inspect import signature
from typing import Any

import torch
from tensordict import TensorDict

try:
    from torch._dynamo.exc import BackendCompilerFailed
    from torch._inductor.exc import InductorError

    COMPILER_ERRORS: tuple[type[Exception], ...] = (
        BackendCompilerFailed,
        InductorError,
    )
except ImportError:  # their base class
    COMPILER_ERRORS = (RuntimeError,)
"""What `torch.compile` raises where no compiler works."""

TRUSTING = {"cpp.vec_isa_ok": True}
"""Take the processor's vector instructions from its name: to try each out, as torch does
on a machine that has not compiled before, takes the compiler twenty seconds."""


def compile_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """Keywords of `torch.compile` that this torch knows.

    Compilations of one env do not count against those of another (``isolate_recompiles``),
    where torch can tell them apart (from 2.13 on).
    """
    known = signature(torch.compile).parameters
    isolated = {"isolate_recompiles": True} if "isolate_recompiles" in known else {}
    if options.keys() & {"mode", "backend"}:
        return {**isolated, **options}
    own = options.get("options", {})
    return {**isolated, **options, "options": {**TRUSTING, **own}}


def tensordict_of(
    entries: dict[str, Any], batch_size: torch.Size, device: torch.device | None
) -> TensorDict:
    """A tensordict of entries that are known to fit; unchecked, in a third of the time."""
    make = getattr(TensorDict, "_new_unsafe", TensorDict)
    return make(entries, batch_size=batch_size, device=device)
