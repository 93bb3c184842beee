"""Products of features, beside a network of sums."""

from dataclasses import replace

import pytest
import torch
from dynamics_helpers import enliven

from torchrl_nerd.modules.networks import MLPConfig
from torchrl_nerd.modules.products import BOUND, Products
from torchrl_nerd.modules.transformer import TransformerConfig

INPUTS, OUTPUTS, WIDTH, ROWS = 5, 3, 16, 7


def test_they_are_what_the_formula_says(generator):
    made = Products(INPUTS, OUTPUTS, WIDTH, 1).double()
    token = torch.randn(ROWS, INPUTS, generator=generator, dtype=torch.float64)
    x, h = torch.randn(2, ROWS, WIDTH, generator=generator, dtype=torch.float64)
    before, factors = made.enter(x, token)
    left, right, direct = (
        token @ layer.weight.T + layer.bias
        for layer in (made.left, made.right, made.direct)
    )
    products = left * right
    torch.testing.assert_close(before, x + products @ made.entry.weight.T)
    torch.testing.assert_close(factors, direct + products @ made.factors.weight.T)
    after = made.leave(torch.zeros(ROWS, OUTPUTS).double(), h, factors)
    gated = (h @ made.gate.weight.T) * factors
    expected = gated @ made.readout.weight.T + made.readout.bias
    torch.testing.assert_close(after, expected)


def test_they_stay_bounded_behind_the_largest_contact_forces(generator):
    made = Products(INPUTS, OUTPUTS, WIDTH, 1).double()
    token = torch.randn(ROWS, INPUTS, generator=generator, dtype=torch.float64)
    token = torch.where(token.abs() > 0.3, token.sign() * 2.0 * BOUND, token)
    x = torch.randn(ROWS, WIDTH, generator=generator, dtype=torch.float64)
    inside = made.enter(x, token.clamp(-BOUND, BOUND))
    assert all(map(torch.equal, made.enter(x, token), inside))


def test_without_blocks_and_head_a_network_is_a_polynomial_of_degree_four(generator):
    """Of the token: two for the gate, two for what it multiplies."""
    network = enliven(
        MLPConfig(0, WIDTH, products=True).build(INPUTS, OUTPUTS), generator
    )
    network = network.double()
    torch.nn.init.zeros_(network.head[-1].weight)
    token = torch.randn(ROWS, INPUTS, generator=generator, dtype=torch.float64)
    scales = torch.arange(-2.0, 4.0, dtype=torch.float64)
    along = torch.stack([network(scale * token) for scale in scales])
    size = along.abs().max()
    for _ in range(4):
        along = along.diff(dim=0)
    assert along.abs().max() > 1e-3 * size
    assert along.diff(dim=0).abs().max() < 1e-12 * size


@pytest.mark.parametrize("config", [MLPConfig(2, 16), TransformerConfig(2, 16, 2, 3)])
def test_silent_they_change_nothing(config, generator):
    plain = enliven(config.build(INPUTS, OUTPUTS), generator)
    network = replace(config, products=True).build(INPUTS, OUTPUTS)
    network.load_state_dict(plain.state_dict(), strict=False)
    tokens = torch.randn(ROWS, 4, INPUTS, generator=generator)
    assert not torch.allclose(network(tokens), plain(tokens), atol=1e-3)
    network.products.silence()
    assert torch.equal(network(tokens), plain(tokens))
