"""What acts in an env."""

from collections.abc import Callable

from tensordict import TensorDictBase

Actor = Callable[[TensorDictBase], TensorDictBase]
"""Any TorchRL policy: reads ``observation``, writes ``action``; see `frame_stack_of`."""
