"""Low-rank changes of weights: few numbers to train, added to the weights when done.

Source: Hu et al., "LoRA: Low-Rank Adaptation of Large Language Models" (ICLR 2022,
arXiv 2106.09685).
"""

import torch
from torch import Tensor, nn
from torch.nn.utils import parametrize


class LowRank(nn.Module):
    """``W + B A`` with ``B (m, rank)`` zero at first and ``A (rank, n)`` random."""

    def __init__(self, weight: Tensor, rank: int) -> None:
        super().__init__()
        rows, columns = weight.shape
        self.a = nn.Parameter(torch.randn(rank, columns).to(weight) * columns**-0.5)
        self.b = nn.Parameter(weight.new_zeros(rows, rank))

    def forward(self, weight: Tensor) -> Tensor:
        """The changed weight."""
        return weight + self.b @ self.a


def add_low_rank(network: nn.Module, rank: int) -> None:
    """Give every linear layer a low-rank change, in place."""
    for module in list(network.modules()):
        if isinstance(module, nn.Linear):
            change = LowRank(module.weight, rank)
            parametrize.register_parametrization(module, "weight", change)


def merge_low_rank(network: nn.Module) -> None:
    """Add all changes to the weights and take them away, in place.

    Torch's own removal takes ``weight`` from the layer's class, which copies share: a copy
    could not be merged without breaking the layer that it is of.
    """
    for module in list(network.modules()):
        if isinstance(module, nn.Linear) and parametrize.is_parametrized(module):
            weight = nn.Parameter(module.weight.detach().clone())
            del module.parametrizations
            module.__class__ = type(module).__bases__[0]
            module.weight = weight
