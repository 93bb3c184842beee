"""What acts in an env, and what it hands over."""

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import ArrayLike
from tensordict import TensorDictBase
from torch import Tensor

Actor = Callable[[TensorDictBase], TensorDictBase]
"""Any TorchRL policy: reads ``observation``, writes ``action``; see `frame_stack_of`."""


def as_action(array: ArrayLike) -> Tensor:
    """An action as float32, a copy: arrays may be read-only, as JAX's are, or reversed."""
    return torch.as_tensor(np.array(array, order="C"), dtype=torch.float32)
