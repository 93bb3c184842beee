"""What an env shows where only some of its envs begin anew."""

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor


def merge_reset(
    rows: Tensor, before: TensorDictBase, fresh: TensorDictBase
) -> dict[str, Any]:
    """The reset's entries in ``rows``, those of before elsewhere.

    Entries that the reset does not have, such as the last action, are zero in ``rows``.

    Args:
        rows: bool ``(num_envs,)``: which begin anew.
        before: what the env showed.
        fresh: what it shows after the reset, of all envs.
    """
    new = dict(fresh.items())
    return new | {
        k: torch.where(_beside(rows, x), new[k], x) if k in new else _emptied(rows, x)
        for k, x in before.items()
        if k != "_reset"
    }


def _beside(rows: Tensor, value: Tensor) -> Tensor:
    """The mask ``(num_envs,)`` in as many dimensions as a value ``(num_envs, ...)``."""
    return rows.reshape(-1, *[1] * (value.ndim - 1))


def _emptied(rows: Tensor, value: Any) -> Any:
    """Zeros in those envs, of a tensor or of all that a tensordict holds."""
    if isinstance(value, Tensor):
        return value.masked_fill(_beside(rows, value), 0)
    if isinstance(value, TensorDictBase):
        return value.apply(lambda x: _emptied(rows, x))
    return value
