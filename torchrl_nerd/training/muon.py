"""Muon: steps along momentum whose singular values are all brought to about one.

Source: https://kellerjordan.github.io/posts/muon. `torch.optim.Muon` multiplies in bfloat16
everywhere. An update takes it 12 to 17 times as long on a processor that emulates bfloat16,
see ``experiments/muon.py``. Here such a processor computes in float32.
"""

from collections.abc import Iterable
from math import sqrt

import torch
from torch import Tensor
from torch.optim import Optimizer

from torchrl_nerd.modules.linear import has_bfloat16

COEFFICIENTS = (3.4445, -4.7750, 2.0315)  # of the quintic, steep at zero
ITERATIONS = 5


class Muon(Optimizer):
    """Steps of a matrix of size ``lr * sqrt(max(1, rows / columns))``, without decay.

    Args:
        params: matrices ``(*blocks, rows, columns)``, every block a matrix of its own.
        lr: step size.
        momentum: Nesterov's.
    """

    def __init__(
        self, params: Iterable[Tensor], lr: float, momentum: float = 0.95
    ) -> None:
        super().__init__(params, {"lr": lr, "momentum": momentum})

    @torch.no_grad()
    def step(self, closure: None = None) -> None:  # pyright: ignore
        """Update every matrix that has a gradient, those of one shape together."""
        for group in self.param_groups:
            momentum, by_shape = group["momentum"], {}
            for weight in group["params"]:
                if weight.grad is None:
                    continue
                state = self.state[weight]
                if not state:
                    state["momentum_buffer"] = torch.zeros_like(weight)
                mean = state["momentum_buffer"].lerp_(weight.grad, 1.0 - momentum)
                update = weight.grad.lerp(mean, momentum)
                blocks = zip(_blocks(weight), _blocks(update), strict=True)
                by_shape.setdefault(weight.shape[-2:], []).extend(blocks)
            for (rows, columns), pairs in by_shape.items():
                weights, updates = zip(*pairs, strict=True)
                size = group["lr"] * sqrt(max(1.0, rows / columns))
                directions = orthogonalize(torch.stack(updates))
                for weight, direction in zip(weights, directions, strict=True):
                    weight.add_(direction, alpha=-size)


def _blocks(weight: Tensor) -> tuple[Tensor, ...]:
    """Its matrices ``(rows, columns)``, views."""
    return weight.reshape(-1, *weight.shape[-2:]).unbind(0)


def orthogonalize(matrices: Tensor) -> Tensor:
    """Matrices ``(n, rows, columns)`` with singular values of about one, 0.5 to 1.5.

    Five iterations of Newton and Schulz, ``x <- a x + b (x x') x + c (x x')^2 x``, in
    bfloat16 where the device has it.
    """
    a, b, c = COEFFICIENTS
    is_tall = matrices.shape[-2] > matrices.shape[-1]
    x = matrices.bfloat16() if has_bfloat16(matrices.device) else matrices
    x = x.mT if is_tall else x
    x = x / (torch.linalg.matrix_norm(x, keepdim=True) + 1e-7)
    for _ in range(ITERATIONS):
        gram = x @ x.mT
        x = torch.baddbmm(
            x, torch.baddbmm(gram, gram, gram, beta=b, alpha=c), x, beta=a
        )
    return x.mT if is_tall else x
