"""Linear layers of a network whose inner matrices may be bfloat16.

`NeRD.to(torch.bfloat16)` rounds the matrices of its blocks alone. A gap or a change of
speed that is rounded to the 8 bits of bfloat16 is off by up to 0.4%, while roundings inside
the network average out. Products are summed in float32 by the processor.
"""

from collections.abc import Callable

import torch
from torch import Tensor, nn


class FullLinear(nn.Linear):
    """For the ends of a network: at least float32, whatever autocast or ``to`` says."""

    def forward(self, input: Tensor) -> Tensor:
        """``(*batch, in) -> (*batch, out)``, in the precision of the weights."""
        input, device = input.to(self.weight.dtype), input.device.type
        if not torch.is_autocast_enabled(device):
            return self.multiply(input)
        with torch.autocast(device, enabled=False):
            return self.multiply(input)

    def multiply(self, x: Tensor) -> Tensor:
        """What the layer does, once precisions are settled."""
        return super().forward(x)

    def _apply(
        self, fn: Callable[[Tensor], Tensor], recurse: bool = True
    ) -> "FullLinear":
        def apply(x: Tensor) -> Tensor:
            moved = fn(x)
            return moved if moved.dtype.itemsize >= 4 else x.to(moved.device)

        super()._apply(apply, recurse)
        return self


class InnerLinear(nn.Linear):
    """For blocks: may be bfloat16 where what it multiplies is not."""

    def forward(self, input: Tensor) -> Tensor:
        """``(*batch, in) -> (*batch, out)``, in autocast's precision or the input's."""
        is_cast = torch.is_autocast_enabled(input.device.type)
        if is_cast or self.weight.dtype != torch.bfloat16:
            return self.multiply(input)
        return self.multiply(input.bfloat16()).to(input.dtype)

    def multiply(self, x: Tensor) -> Tensor:
        """What the layer does, once precisions are settled."""
        return super().forward(x)


def has_bfloat16(device: torch.device) -> bool:
    """Whether it multiplies in bfloat16.

    Other processors emulate it: a product takes 25 to 45 times as long as in float32.
    """
    if device.type != "cpu":
        return True
    has = torch.cpu.get_capabilities()
    return has.get("avx512_bf16", False) or has.get("amx_bf16", False)


def in_bfloat16(
    function: Callable[..., Tensor], device: torch.device
) -> Callable[..., Tensor]:
    """A function under autocast, or as it is on a device without bfloat16."""
    if not has_bfloat16(device):
        return function
    return torch.autocast(device.type, torch.bfloat16)(function)
