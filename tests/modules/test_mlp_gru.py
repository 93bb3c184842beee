"""MLP and GRU speak the transformer's language: sequences, steps, a memory per env."""

import pytest
import torch
from dynamics_helpers import enliven
from torch import Generator, Tensor, nn

from torchrl_nerd.modules.networks import GRUConfig, MLPConfig

INPUTS, OUTPUTS, ROWS, STEPS = 5, 3, 4, 14
CONFIGS = {
    "mlp-4x64": MLPConfig(),
    "linear": MLPConfig(depth=0),
    "gru": GRUConfig(),
    "deep gru": GRUConfig(layers=3, width=16),
}


@pytest.mark.parametrize(
    "config", [MLPConfig(depth=-1), MLPConfig(width=0), GRUConfig(layers=0)]
)
def test_sizes_that_no_network_has_are_refused(config):
    with pytest.raises(ValueError, match="a whole number of at least"):
        config.build(INPUTS, OUTPUTS)


each_config = pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS)


def build(config: MLPConfig | GRUConfig, generator: Generator, dtype=torch.float64):
    return enliven(config.build(INPUTS, OUTPUTS), generator).to(dtype)


def randn(generator: Generator, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def stream(
    network: nn.Module, tokens: Tensor, cleared: Tensor, when: int
) -> tuple[Tensor, Tensor]:
    """Outputs before and after the step at which ``cleared`` rows forget."""
    memory, outputs = network.empty_memory(len(tokens)), []
    for t, token in enumerate(tokens.unbind(1)):
        if t == when:
            memory.clear(cleared)
        outputs.append(network.step(token, memory))
    output = torch.stack(outputs, 1)
    return output[:, :when], output[:, when:]


@each_config
def test_steps_go_on_from_a_history_that_was_read_at_once(config, generator):
    network, tokens = build(config, generator), randn(generator, ROWS, STEPS, INPUTS)
    memory = network.empty_memory(ROWS)
    first = network.read(tokens[:, :9], memory)
    rest = [network.step(token, memory) for token in tokens[:, 9:].unbind(1)]
    both = torch.cat((first, torch.stack(rest, 1)), 1)
    torch.testing.assert_close(both, network(tokens), rtol=0, atol=1e-12)


@each_config
@pytest.mark.parametrize(
    ("dtype", "tolerance"), [(torch.float32, 1e-5), (torch.float64, 1e-12)]
)
def test_stepping_equals_the_full_sequence(config, dtype, tolerance, generator):
    network = build(config, generator, dtype)
    tokens = randn(generator, ROWS, STEPS, INPUTS).to(dtype)
    rows = torch.tensor([False, True, False, True])
    with torch.no_grad():
        before, after = stream(network, tokens, rows, 6)
        whole, restarted = network(tokens), network(tokens[:, 6:])
    close = {"atol": tolerance, "rtol": tolerance}
    torch.testing.assert_close(before, whole[:, :6], **close)
    torch.testing.assert_close(after[~rows], whole[~rows, 6:], **close)
    torch.testing.assert_close(after[rows], restarted[rows], **close)


@each_config
def test_nothing_of_a_cleared_history_leaks(config, generator):
    network = build(config, generator)
    tokens = randn(generator, ROWS, STEPS, INPUTS)
    rows = torch.tensor([False, True, False, False])
    junk = tokens.clone()
    junk[1, :6] = torch.nan
    with torch.no_grad():
        _, polluted = stream(network, junk, rows, 6)
        _, clean = stream(network, tokens, rows, 6)
    assert torch.equal(polluted, clean)


@each_config
def test_gradients_through_stepping_equal_the_full_sequence(config, generator):
    network = build(config, generator)
    tokens = randn(generator, ROWS, STEPS, INPUTS).requires_grad_()
    rows = torch.tensor([False, True, False, True])
    before, after = stream(network, tokens, rows, 6)
    whole, restarted = network(tokens), network(tokens[:, 6:])
    later = torch.where(rows[:, None, None], restarted, whole[:, 6:])
    wanted = [tokens, *network.parameters()]
    stepped = torch.autograd.grad(before.square().sum() + after.square().sum(), wanted)
    expected = torch.autograd.grad(
        whole[:, :6].square().sum() + later.square().sum(), wanted
    )
    for got, want in zip(stepped, expected, strict=True):
        torch.testing.assert_close(got, want, atol=1e-10, rtol=1e-10)


@pytest.mark.parametrize("name", ["mlp-4x64", "gru"])
def test_only_the_gru_has_a_history(name, generator):
    network = build(CONFIGS[name], generator)
    tokens = randn(generator, ROWS, STEPS, INPUTS)
    changed = tokens.clone()
    changed[:, 3] = randn(generator, ROWS, INPUTS)
    with torch.no_grad():
        later, other = network(tokens)[:, 4:], network(changed)[:, 4:]
    assert torch.equal(later, other) == (name == "mlp-4x64")


@pytest.mark.parametrize("name", ["mlp-4x64", "gru"])
def test_later_tokens_do_not_change_earlier_outputs(name, generator):
    network = build(CONFIGS[name], generator)
    tokens = randn(generator, ROWS, STEPS, INPUTS)
    changed = tokens.clone()
    changed[:, 7:] = torch.nan
    with torch.no_grad():
        assert torch.equal(network(tokens)[:, :7], network(changed)[:, :7])
