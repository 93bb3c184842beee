"""Learned products of features, beside a network of sums.

A robot's acceleration is made of products: M(q)^-1 (torque - C(q, v) v). What a torque does
depends on the pose, and Coriolis forces are products of two velocities. Layers of sums with
an activation function learn those slowly. Here, of a token x,

    p = (L x) * (R x)                                products of features
    h = blocks(E x + W p)                            the network between its ends
    output = head(h) + V ((A h) * (B x + C p))       linear in x and p, as the state says

with * entry by entry. Forces of contact have heavy tails, and products of them run away
where data are few. So an entry of x counts as at most `BOUND` standard deviations here.
"""

from functools import partial

from torch import Tensor, nn

from torchrl_nerd.modules.symmetric import (
    make_embedding,
    make_inner,
    make_product,
    make_readout,
)

BOUND = 10.0  # standard deviations


class Products(nn.Module):
    """Both ends of such a network, as wide as its blocks."""

    def __init__(
        self, num_inputs: int, num_outputs: int, width: int, symmetries: int
    ) -> None:
        super().__init__()
        embedding = partial(make_embedding, num_inputs, width, symmetries)
        inner = partial(make_inner, width, width, symmetries)
        self.left, self.right, self.direct = embedding(), embedding(), embedding()
        self.entry, self.factors, self.gate = inner(), inner(), inner()
        self.multiply = make_product(symmetries)
        self.readout = make_readout(width, num_outputs, symmetries)

    def enter(self, x: Tensor, token: Tensor) -> tuple[Tensor, Tensor]:
        """The blocks' input, and what `leave` multiplies their output with.

        ``x (*batch, *hidden)`` is the embedding of ``token (*batch, F)``.
        """
        token = token.clamp(-BOUND, BOUND)
        products = self.multiply(self.left(token), self.right(token))
        return x + self.entry(products), self.direct(token) + self.factors(products)

    def leave(self, output: Tensor, x: Tensor, factors: Tensor) -> Tensor:
        """The head's output ``(*batch, D)`` with what the products add to it."""
        return output + self.readout(self.multiply(self.gate(x), factors))

    def silence(self) -> None:
        """Add nothing, until trained."""
        for weight in (self.entry.weight, *self.readout.parameters()):
            nn.init.zeros_(weight)


class NoProducts(nn.Module):
    """A network of sums alone."""

    def enter(self, x: Tensor, token: Tensor) -> tuple[Tensor, Tensor]:
        """See `Products.enter`."""
        return x, x

    def leave(self, output: Tensor, x: Tensor, factors: Tensor) -> Tensor:
        """See `Products.leave`."""
        return output

    def silence(self) -> None:
        """Nothing to do."""


def make_products(
    has_products: bool, num_inputs: int, num_outputs: int, width: int, symmetries: int
) -> Products | NoProducts:
    """Those that a network's configuration asks for."""
    if not has_products:
        return NoProducts()
    return Products(num_inputs, num_outputs, width, symmetries)
