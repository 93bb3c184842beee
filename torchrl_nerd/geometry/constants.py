"""Numbers of a robot on the device of a state: copied there once, not at every step.

A copy from the host makes an accelerator wait, and cannot be part of a CUDA graph.
"""

import copy
from collections.abc import Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

Module = TypeVar("Module", bound=nn.Module)

_kept: dict[tuple, Tensor] = {}


def constant(like: Tensor, values: Any) -> Tensor:
    """``values``, nested numbers, in dtype and on device of ``like``; never write to it."""
    return _constant(_frozen(values), like.dtype, like.device)


def take(x: Tensor, places: Sequence[int], dim: int = -1) -> Tensor:
    """The entries of ``x`` at ``places`` along a dimension, in this order; a copy."""
    if x.device.type == "cpu":  # reads a list as fast, and compiled code knows it
        return x[(slice(None),) * (dim % x.ndim) + (list(places),)]
    return x.index_select(dim, _constant(tuple(places), torch.int64, x.device))


def cast_constants(module: Module, dtype: torch.dtype) -> Module:
    """The module itself, its float64 numbers in another precision, and finite there."""
    limit = torch.finfo(dtype).max
    for x in (*module.buffers(), *module.parameters()):
        if x.dtype == torch.float64:
            x.data = x.data.clamp(-limit, limit).to(dtype)
    return module


def placed(module: Module, like: Tensor) -> Module:
    """A module of constants on the device of a state, and in its precision.

    Whoever steps in float64 shares the module itself; others share a copy.
    """
    if like.dtype == torch.float64:
        return module.to(like.device)
    copies = getattr(module, "_coarse", None)
    if copies is None:
        copies = vars(module)["_coarse"] = {}
    if like.dtype not in copies:
        with torch.inference_mode(False):  # kept, whoever asks first
            copies[like.dtype] = cast_constants(copy.deepcopy(module), like.dtype)
    return copies[like.dtype].to(like.device)


def _constant(values: Any, dtype: torch.dtype, device: torch.device) -> Tensor:
    if torch.compiler.is_compiling() and _bakes(device):
        return torch.tensor(values, dtype=dtype, device=device)
    key = values, dtype, str(device)
    if key not in _kept:
        with torch.inference_mode(False):
            _kept[key] = torch.tensor(values, dtype=dtype, device=device)
    return _kept[key]


def _bakes(device: torch.device) -> bool:
    """Whether compiled code holds constants itself; elsewhere it would copy them there."""
    return device.type == "cpu"


def _frozen(values: Any) -> Any:
    """``values`` as a key: sequences as tuples."""
    if isinstance(values, tuple | list):
        return tuple(map(_frozen, values))
    return values
