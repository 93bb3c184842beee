"""Numbers that a module computes with and a checkpoint does not hold."""

import numpy as np
import torch
from torch import nn


def keep_constants(module: nn.Module, **values: object) -> None:
    """Copies as float64 buffers of these names: they move with the module, unsaved.

    Args:
        module: whose.
        values: numbers, arrays or tensors of any shape.
    """
    for name, value in values.items():
        tensor = torch.from_numpy(np.array(value, dtype=np.float64))
        module.register_buffer(name, tensor, persistent=False)
