"""Muon: momentum whose matrix updates are made orthogonal.

Source: Jordan et al., "Muon: An optimizer for hidden layers in neural networks" (2024),
https://kellerjordan.github.io/posts/muon. Same update as `torch.optim.Muon`, which
iterates on whole matrices in bfloat16. Here the iteration runs on their Gram matrices, in
float32 and for all matrices of one shape at once: half the arithmetic, and exact to 1e-3
where bfloat16 is off by a sixth.
"""

from collections.abc import Iterable
from typing import cast

import torch
from torch import Tensor
from torch.optim import Optimizer

COEFFICIENTS = (3.4445, -4.7750, 2.0315)  # quintic of the source
ITERATIONS = 5


def orthogonalize(matrices: Tensor) -> Tensor:
    """Nearest matrices with equal singular values, ``(*batch, m, n)``, approximately.

    The quintic Newton-Schulz iteration brings all singular values to about 1 (0.7-1.2).
    Its iterates are polynomials of the Gram matrix times the matrix, so that all products
    but the first and the last are of the smaller side alone.
    """
    with torch.autocast(matrices.device.type, enabled=False):
        is_tall = matrices.shape[-2] > matrices.shape[-1]
        x = matrices.mT if is_tall else matrices
        x = x / (torch.linalg.matrix_norm(x, keepdim=True) + 1e-12)
        gram = x @ x.mT
        product = factor = _quintic(gram)
        for _ in range(ITERATIONS - 1):
            gram = factor @ gram @ factor
            factor = _quintic(gram)
            product = factor @ product
        x = product @ x
        return x.mT if is_tall else x


def _quintic(gram: Tensor) -> Tensor:
    """What one iteration multiplies with."""
    a, b, c = COEFFICIENTS
    factor = b * gram + c * gram @ gram
    factor.diagonal(dim1=-2, dim2=-1).add_(a)
    return factor


class Muon(Optimizer):
    """For weight matrices; give all other parameters to another optimiser.

    Args:
        params: matrices.
        lr: step size; an update moves a weight by about ``lr * sqrt(max(1, m/n)/n)``.
        momentum: Nesterov momentum.
    """

    def __init__(
        self, params: Iterable[Tensor], lr: float = 0.02, momentum: float = 0.95
    ) -> None:
        super().__init__(params, {"lr": lr, "momentum": momentum})

    @torch.no_grad()
    def step(self, closure: None = None) -> None:  # pyright: ignore
        """One update of every matrix that has a gradient."""
        for group in self.param_groups:
            by_shape: dict[torch.Size, list[Tensor]] = {}
            for weight in group["params"]:
                if weight.grad is not None:
                    by_shape.setdefault(weight.shape, []).append(weight)
            for shape, weights in by_shape.items():
                self._step_shape(shape, weights, group["lr"], group["momentum"])

    def _step_shape(
        self, shape: torch.Size, weights: list[Tensor], lr: float, momentum: float
    ) -> None:
        updates = []
        for weight in weights:
            state, gradient = self.state[weight], cast(Tensor, weight.grad)
            if "momentum" not in state:
                state["momentum"] = torch.zeros_like(weight)
            state["momentum"].lerp_(gradient, 1.0 - momentum)
            updates.append(gradient.lerp(state["momentum"], momentum))
        scale = lr * max(1.0, shape[0] / shape[1]) ** 0.5
        for weight, update in zip(
            weights, orthogonalize(torch.stack(updates)), strict=True
        ):
            weight.add_(update, alpha=-scale)
