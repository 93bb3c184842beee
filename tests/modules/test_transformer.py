"""Streaming is the full sequence under the same band, one token at a time."""

import pytest
import torch
from dynamics_helpers import enliven
from torch import Generator, Tensor, nn

from torchrl_nerd.modules.linear import FullLinear
from torchrl_nerd.modules.networks import TRANSFORMERS, network_config
from torchrl_nerd.modules.transformer import CausalTransformer, TransformerConfig

INPUTS, OUTPUTS = 5, 3
CONFIGS = {
    "transformer-2x64": TRANSFORMERS["transformer-2x64"],
    "long band": network_config("transformer-2x64@64"),
    "narrow band": TransformerConfig(layers=1, width=8, heads=1, band=2),
    "pairs": TransformerConfig(layers=2, width=16, heads=2, band=4, pairs=True),
    "deep": TransformerConfig(layers=3, width=24, heads=3, band=4),
    "symmetric": TransformerConfig(2, 16, 2, band=4, pairs=True, symmetries=4),
    "products": TransformerConfig(2, 16, 2, band=4, pairs=True, products=True),
}
each_config = pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS)
each_precision = pytest.mark.parametrize(
    ("dtype", "tolerance"), [(torch.float32, 1e-5), (torch.float64, 1e-12)]
)


def build(config: TransformerConfig, generator: Generator, dtype=torch.float64):
    return enliven(config.build(INPUTS, OUTPUTS), generator).to(dtype)


def randn(generator: Generator, *shape: int, dtype=torch.float64) -> Tensor:
    return torch.randn(*shape, generator=generator, dtype=torch.float64).to(dtype)


def view(config: TransformerConfig) -> int:
    return config.layers * (config.band - 1) + 1 + config.pairs


def stream(network: nn.Module, tokens: Tensor, resets: Tensor | None = None) -> Tensor:
    """Token by token; ``resets (rows, T)`` empties histories before a token."""
    memory = network.empty_memory(len(tokens))
    outputs = []
    for t in range(tokens.shape[1]):
        if resets is not None:
            memory.clear(resets[:, t])
        outputs.append(network.step(tokens[:, t], memory))
    return torch.stack(outputs, 1)


def episodes(network: nn.Module, tokens: Tensor, resets: Tensor) -> Tensor:
    """Every episode of every env as one full sequence of its own."""
    outputs = []
    for row, starts in zip(tokens, resets, strict=True):
        cuts = [0, *starts[1:].nonzero()[:, 0].add(1).tolist(), len(row)]
        parts = [row[a:b] for a, b in zip(cuts[:-1], cuts[1:], strict=True)]
        outputs.append(torch.cat([network(part[None])[0] for part in parts]))
    return torch.stack(outputs)


@each_config
@pytest.mark.parametrize("is_recorded", [False, True], ids=["in place", "gradients"])
def test_steps_go_on_from_a_history_that_was_read_at_once(
    config, is_recorded, generator
):
    """Shorter than the band, as long, longer; also in an env that is reset after it."""
    network = build(config, generator)
    for count in {1, config.band - 1, config.band, 2 * config.band + 1}:
        tokens = randn(generator, 4, count + 3, INPUTS)
        later, expected = tokens[:, count:], network(tokens)
        with torch.set_grad_enabled(is_recorded):
            memory = network.empty_memory(4)
            outputs = [network.read(tokens[:, :count], memory)]
            memory.clear(torch.tensor([False, True, False, False]))
            outputs += [network.step(x, memory)[:, None] for x in later.unbind(1)]
        expected = expected.clone()
        expected[1, count:] = network(later[1:2])[0]
        torch.testing.assert_close(torch.cat(outputs, 1), expected, rtol=0, atol=1e-12)


def random_resets(rows: int, steps: int, generator: Generator) -> Tensor:
    """Rows restart at times of their own; the first row never does."""
    resets = torch.rand(rows, steps, generator=generator) < 3.0 / steps
    resets[0] = False
    resets[1, steps // 2] = True
    return resets


@each_config
@each_precision
def test_streaming_equals_the_full_sequence(config, dtype, tolerance, generator):
    network = build(config, generator, dtype)
    tokens = randn(generator, 4, view(config) + 15, INPUTS, dtype=dtype)
    resets = random_resets(4, tokens.shape[1], generator)
    with torch.no_grad():
        streamed = stream(network, tokens, resets)
        expected = episodes(network, tokens, resets)
    scale = float(expected.abs().max())  # random weights: not of order one
    torch.testing.assert_close(streamed, expected, atol=tolerance * scale, rtol=0.0)


@each_config
@pytest.mark.parametrize("has_resets", [False, True], ids=["whole", "partial resets"])
def test_gradients_through_streaming_equal_the_full_sequence(
    config, has_resets, generator
):
    network = build(config, generator)
    tokens = randn(generator, 3, config.band + 6, INPUTS).requires_grad_()
    weight = randn(generator, 3, tokens.shape[1], OUTPUTS)
    resets = random_resets(3, tokens.shape[1], generator) & has_resets
    wanted = [tokens, *network.parameters()]
    streamed = torch.autograd.grad(
        (weight * stream(network, tokens, resets)).sum(), wanted
    )
    expected = torch.autograd.grad(
        (weight * episodes(network, tokens, resets)).sum(), wanted
    )
    for got, want in zip(streamed, expected, strict=True):
        torch.testing.assert_close(got, want, atol=1e-10, rtol=1e-10)
        assert got.abs().max() > 0.0


@each_config
def test_recording_gradients_may_begin_at_any_step(config, generator):
    network = build(config, generator)
    tokens = randn(generator, 3, config.band + 6, INPUTS)
    memory, outputs = network.empty_memory(3), []
    is_recorded = torch.rand(tokens.shape[1], generator=generator) < 0.5
    for token, recorded in zip(tokens.unbind(1), is_recorded.tolist(), strict=True):
        with torch.set_grad_enabled(recorded):
            outputs.append(network.step(token, memory).detach())
    torch.testing.assert_close(
        torch.stack(outputs, 1), network(tokens).detach(), atol=1e-12, rtol=1e-12
    )


@each_config
def test_later_tokens_do_not_change_earlier_outputs(config, generator):
    network = build(config, generator)
    tokens = randn(generator, 3, 12, INPUTS)
    changed = tokens.clone()
    changed[:, 7:] = randn(generator, 3, 5, INPUTS)
    before, after = network(tokens), network(changed)
    assert torch.equal(before[:, :7], after[:, :7])
    assert not torch.isclose(before[:, 7:], after[:, 7:]).all(-1).any()


@each_config
def test_an_output_sees_exactly_its_view(config, generator):
    network = build(config, generator)
    tokens = randn(generator, 1, view(config) + 5, INPUTS).requires_grad_()
    (gradient,) = torch.autograd.grad(network(tokens)[0, -1].square().sum(), tokens)
    is_seen = gradient[0].abs().amax(-1) > 0.0
    assert is_seen.tolist() == [False] * 5 + [True] * view(config)


@each_config
def test_nothing_of_a_cleared_history_leaks(config, generator):
    network = build(config, generator)
    tokens = randn(generator, 4, 2 * config.band, INPUTS)
    row = torch.tensor([False, True, False, False])
    junk = tokens.clone()
    start = 1 + int(torch.randint(config.band, (), generator=generator))
    junk[1, :start] = torch.tensor(
        [float("nan"), float("inf"), 1e30, -float("inf"), 0.0], dtype=junk.dtype
    )
    resets = torch.zeros(4, tokens.shape[1], dtype=torch.bool)
    resets[1, start] = True
    with torch.no_grad():
        polluted, clean = stream(network, junk, resets), stream(network, tokens)
        fresh = network(tokens[1:2, start:])
    assert torch.equal(polluted[~row], clean[~row])
    torch.testing.assert_close(polluted[row, start:], fresh, atol=1e-12, rtol=1e-12)
    assert not torch.isclose(fresh, clean[row, start:]).all()  # the history did matter


@each_config
@each_precision
def test_rows_do_not_mix(config, dtype, tolerance, generator):
    network = build(config, generator, dtype)
    tokens = randn(generator, 6, config.band + 5, INPUTS, dtype=dtype)
    with torch.no_grad():
        together = stream(network, tokens)
        alone = torch.cat([stream(network, row[None]) for row in tokens])
    scale = float(together.abs().max())  # random weights: not of order one
    torch.testing.assert_close(together, alone, atol=tolerance * scale, rtol=0.0)


@each_config
def test_outputs_do_not_share_memory_with_the_history(config, generator):
    network = build(config, generator)
    tokens = randn(generator, 2, 8, INPUTS)
    memory, outputs = network.empty_memory(2), []
    with torch.no_grad():
        for token in tokens.clone().unbind(1):
            output = network.step(token, memory)
            outputs.append(output.clone())
            output.fill_(torch.nan)
            token.fill_(torch.nan)
        assert torch.equal(torch.stack(outputs, 1), stream(network, tokens))


@pytest.mark.parametrize("name", TRANSFORMERS)
def test_every_preset_gives_one_finite_output_per_token(name, generator):
    network = TRANSFORMERS[name].build(INPUTS, OUTPUTS)
    with torch.no_grad():
        output = network(randn(generator, 2, 3, INPUTS, dtype=torch.float32))
    assert output.shape == (2, 3, OUTPUTS) and output.isfinite().all()


@pytest.mark.parametrize(
    ("sizes", "named"),
    [
        ({"width": 64, "heads": 5}, "heads"),
        ({"heads": 0}, "heads"),
        ({"layers": 0}, "layers"),
        ({"band": 1}, "band"),
    ],
)
def test_sizes_that_make_no_transformer_are_refused(sizes, named):
    with pytest.raises(ValueError, match=f"expected.*{named}.*got"):
        CausalTransformer(TransformerConfig(**sizes), INPUTS, OUTPUTS)


def test_autocast_leaves_the_ends_of_a_network_only(generator):
    tokens = randn(generator, 6, INPUTS, dtype=torch.float32)
    for layer in (FullLinear(INPUTS, OUTPUTS), FullLinear(INPUTS, OUTPUTS, bias=False)):
        with torch.autocast("cpu", torch.bfloat16):
            found = layer(tokens)
            assert nn.Linear(INPUTS, OUTPUTS)(tokens).dtype == torch.bfloat16
        assert torch.equal(
            found, nn.functional.linear(tokens, layer.weight, layer.bias)
        )


def test_a_name_says_the_band():
    assert network_config("transformer-2x64@64") == TransformerConfig(2, 64, 4, band=64)
    for name in ("gru@64", "transformer-2x64@many"):
        with pytest.raises(ValueError, match=f"its band, got '{name}'"):
            network_config(name)
