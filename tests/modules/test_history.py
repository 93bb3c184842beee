"""Window mode runs a network on each env's last h tokens, no more and no fewer."""

import pytest
import torch
from dynamics_helpers import enliven
from torch import Generator, Tensor, nn

from torchrl_nerd.modules.history import WindowNetwork
from torchrl_nerd.modules.networks import NETWORKS

INPUTS, OUTPUTS, ROWS, STEPS = 5, 3, 4, 24
each_network = pytest.mark.parametrize("name", ["transformer-2x64", "mlp-4x64", "gru"])


def build(name: str, size: int, generator: Generator) -> WindowNetwork:
    network = enliven(NETWORKS[name].build(INPUTS, OUTPUTS), generator)
    return WindowNetwork(network.double(), size, INPUTS)


def randn(generator: Generator, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def stream(network: nn.Module, tokens: Tensor, resets: Tensor) -> Tensor:
    memory, outputs = network.empty_memory(len(tokens)), []
    for t, token in enumerate(tokens.unbind(1)):
        memory.clear(resets[:, t])
        outputs.append(network.step(token, memory))
    return torch.stack(outputs, 1)


def recompute(window: WindowNetwork, tokens: Tensor, resets: Tensor) -> Tensor:
    """The definition: for each env and step, the network on the tokens it may see."""
    outputs = torch.empty(*tokens.shape[:2], OUTPUTS, dtype=tokens.dtype)
    for row in range(len(tokens)):
        start = 0
        for t in range(tokens.shape[1]):
            start = t if resets[row, t] else start
            first = max(start, t - window.size + 1)
            outputs[row, t] = window.network(tokens[row : row + 1, first : t + 1])[
                0, -1
            ]
    return outputs


@each_network
@pytest.mark.parametrize("size", [1, 3, 10])
def test_window_is_the_network_on_the_last_tokens(name, size, generator):
    window = build(name, size, generator)
    tokens = randn(generator, ROWS, STEPS, INPUTS)
    resets = torch.rand(ROWS, STEPS, generator=generator) < 0.15
    resets[0] = False
    resets[1, STEPS // 2] = True
    with torch.no_grad():
        streamed = stream(window, tokens, resets)
        expected = recompute(window, tokens, resets)
    torch.testing.assert_close(streamed, expected, atol=1e-12, rtol=1e-12)


def test_depth_widens_the_streaming_view_beyond_the_window(generator):
    window = build("transformer-2x64", NETWORKS["transformer-2x64"].band, generator)
    tokens = randn(generator, ROWS, STEPS, INPUTS)
    never = torch.zeros(ROWS, STEPS, dtype=torch.bool)
    with torch.no_grad():
        streamed = stream(window.network, tokens, never)
        windowed = stream(window, tokens, never)
    size = window.size
    torch.testing.assert_close(
        streamed[:, :size], windowed[:, :size], atol=1e-12, rtol=1e-12
    )
    assert not torch.isclose(streamed[:, size:], windowed[:, size:]).all(-1).any()


@each_network
def test_nothing_of_a_cleared_history_leaks(name, generator):
    window = build(name, 5, generator)
    tokens = randn(generator, ROWS, STEPS, INPUTS)
    when = int(torch.randint(1, STEPS, (), generator=generator))
    resets = torch.zeros(ROWS, STEPS, dtype=torch.bool)
    resets[1, when] = True
    junk = tokens.clone()
    junk[1, :when] = torch.nan
    with torch.no_grad():
        polluted, clean = (stream(window, x, resets) for x in (junk, tokens))
    others = [0, 2, 3]
    assert torch.equal(polluted[others], clean[others])
    assert torch.equal(polluted[1, when:], clean[1, when:])


@each_network
def test_gradients_reach_every_token_of_the_window(name, generator):
    window = build(name, 4, generator)
    tokens = randn(generator, 1, 9, INPUTS).requires_grad_()
    never = torch.zeros(1, 9, dtype=torch.bool)
    last = stream(window, tokens, never)[0, -1].square().sum()
    (gradient,) = torch.autograd.grad(last, tokens)
    expected = window.network(tokens[:, 5:])[0, -1].square().sum()
    (wanted,) = torch.autograd.grad(expected, tokens)
    torch.testing.assert_close(gradient, wanted, atol=1e-12, rtol=1e-12)
    memory = 1 if name == "mlp-4x64" else 4
    assert (gradient[0].abs().amax(-1) > 0.0).sum() == memory
