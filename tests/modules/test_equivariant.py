"""Networks averaged over symmetric copies: equivariant, and the same network otherwise."""

import copy
from dataclasses import replace

import pytest
import torch
from dynamics_helpers import enliven
from torch import Tensor

from torchrl_nerd import from_pretrained
from torchrl_nerd.checkpoint import load_checkpoint
from torchrl_nerd.configs import TrainConfig
from torchrl_nerd.data.simulate import is_sound, simulate
from torchrl_nerd.dynamics import MujocoDynamics, NeRDDynamics
from torchrl_nerd.evaluation.rollout_error import passive_errors
from torchrl_nerd.geometry.rotations import orientation_error
from torchrl_nerd.keys import JOINT_TORQUE, QPOS, QVEL
from torchrl_nerd.modules.equivariant import EquivariantNetwork
from torchrl_nerd.modules.networks import GRUConfig, MLPConfig
from torchrl_nerd.modules.transformer import TransformerConfig
from torchrl_nerd.robots import load_scene, make_task
from torchrl_nerd.settings import SettingError
from torchrl_nerd.training.samples import data_stats
from torchrl_nerd.training.start import begin_from, make_model, with_copies
from torchrl_nerd.training.symmetry import Symmetry
from torchrl_nerd.training.trainer import Trainer

INPUTS, OUTPUTS, ROWS, STEPS = 6, 4, 5, 9
CONFIGS = {
    "mlp": MLPConfig(2, 16),
    "gru": GRUConfig(2, 16),
    "transformer": TransformerConfig(2, 16, 2, 3),
    "pairs": TransformerConfig(2, 16, 2, 3, pairs=True),
}
# quarter turns of the first entries; the rest stays or changes its sign
TURN = torch.tensor([1, 0, 3, 2, 4, 5]), torch.tensor([1.0, -1, -1, 1, 1, -1])


def powers(turn: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Sources and signs ``(4, size)`` of the group that a quarter turn generates."""
    sources, signs = [torch.arange(len(turn[0]))], [torch.ones(len(turn[0]))]
    for _ in range(3):
        sources.append(sources[-1][turn[0]])
        signs.append(turn[1] * signs[-1][turn[0]])
    return torch.stack(sources), torch.stack(signs)


def transformed(x: Tensor, turn: tuple[Tensor, Tensor]) -> Tensor:
    return x[..., turn[0]] * turn[1].to(x.dtype)


@pytest.fixture(params=list(CONFIGS))
def network(request, generator) -> EquivariantNetwork:
    single = enliven(CONFIGS[request.param].build(INPUTS, OUTPUTS), generator)
    both = EquivariantNetwork(single, 4, INPUTS, OUTPUTS)
    out = TURN[0][:OUTPUTS], TURN[1][:OUTPUTS]
    both.set_copies(powers(TURN), powers(out))
    return both.double()


@pytest.fixture
def tokens(generator) -> Tensor:
    return torch.randn(ROWS, STEPS, INPUTS, dtype=torch.float64, generator=generator)


def stream(network: EquivariantNetwork, tokens: Tensor, when: int, rows: Tensor):
    """Outputs of a stream in which ``rows`` forget before step ``when``."""
    memory, outputs = network.empty_memory(len(tokens)), []
    for step, token in enumerate(tokens.unbind(1)):
        if step == when:
            memory.clear(rows)
        outputs.append(network.step(token, memory))
    return torch.stack(outputs, 1)


@torch.no_grad()
def test_a_copy_of_the_input_gives_the_copy_of_the_output(network, tokens):
    expected = transformed(network(tokens), (TURN[0][:OUTPUTS], TURN[1][:OUTPUTS]))
    torch.testing.assert_close(network(transformed(tokens, TURN)), expected)
    alone = network.network(transformed(tokens, TURN))
    assert not torch.allclose(alone, expected)


@torch.no_grad()
def test_it_is_the_mean_over_the_copies(network, tokens):
    turns = zip(*powers(TURN), strict=True)
    outputs = [network.network(transformed(tokens, turn)) for turn in turns]
    out = powers((TURN[0][:OUTPUTS], TURN[1][:OUTPUTS]))
    back = [torch.empty_like(outputs[0]) for _ in outputs]
    for x, y, source, sign in zip(back, outputs, *out, strict=True):
        x[..., source] = sign * y
    torch.testing.assert_close(network(tokens), sum(back) / 4)


@torch.no_grad()
def test_stepping_equals_the_full_sequence_and_rows_forget_alone(network, tokens):
    rows = torch.arange(ROWS) % 2 == 1
    streamed = stream(network, tokens, 4, rows)
    whole, anew = network(tokens), network(tokens[:, 4:])
    torch.testing.assert_close(streamed[~rows], whole[~rows])
    torch.testing.assert_close(streamed[rows, :4], whole[rows, :4])
    torch.testing.assert_close(streamed[rows, 4:], anew[rows])


@torch.no_grad()
def test_a_history_is_restored_where_it_is_asked_for(network, tokens):
    memory = network.empty_memory(ROWS)
    for token in tokens[:, :4].unbind(1):
        network.step(token, memory)
    past = copy.copy(memory)
    expected = network.step(tokens[:, 4], copy.copy(memory))
    network.step(tokens[:, 5], memory)
    elsewhere = network.step(tokens[:, 6], copy.copy(memory))
    rows = torch.arange(ROWS) < 2
    memory.restore(past, rows)
    here = network.step(torch.where(rows[:, None], tokens[:, 4], tokens[:, 6]), memory)
    torch.testing.assert_close(here[rows], expected[rows])
    torch.testing.assert_close(here[~rows], elsewhere[~rows])


@pytest.fixture(scope="module")
def ant_data():
    data = simulate(load_scene("ant"), 60, 8, torch.Generator().manual_seed(0))
    return data[is_sound(data)]


@pytest.mark.parametrize("name", ["mlp-2x32", "transformer-2x64"])
@torch.no_grad()
def test_a_step_of_the_ant_has_its_symmetries(name, ant_data, generator):
    """Within the training range, of which the network knows the copies alike."""
    scene = load_scene("ant")
    symmetry = Symmetry(scene)
    stats = symmetry.complete(data_stats(scene, ant_data))
    config = TrainConfig(network=name, copies=8)
    model = make_model(scene, config, stats, symmetry).eval()
    enliven(model.network, generator)
    single = begin_from(model, scene, TrainConfig(network=name)).eval()
    state = ant_data[:, 3]

    def stepped(model, start):
        dynamics = NeRDDynamics(model)
        dynamics.reset(start)
        return dynamics.step(start, start[JOINT_TORQUE])

    apart = {}
    for kind, one in (("averaged", model), ("single", single)):
        there, gaps = stepped(one, state), []
        for isometry in symmetry.isometries:
            found, expected = stepped(one, isometry(state)), isometry(there)
            turned = (x[QPOS][:, 3:7] for x in (found, expected))
            gaps.append((found[QVEL] - expected[QVEL]).abs().max())
            gaps.append(orientation_error(*turned).max())
        apart[kind] = float(max(gaps))
    change = (stepped(model, state)[QVEL] - state[QVEL]).abs().max()
    assert apart["averaged"] < 1e-4 * change < apart["single"]


def test_it_is_trained_saved_and_loaded(ant_data, tmp_path):
    """From a model without copies, on single steps and on rollouts."""
    scene, how = load_scene("ant"), dict(network="mlp-1x16", rollout_steps=0)
    sizes = dict(batch_size=8, sequence_length=2, rollout_batch_size=4)
    first = TrainConfig(steps=2, use_symmetry=True, **how | sizes)
    second = replace(first, steps=2, rollout_steps=2, rollout_length=2, copies=4)
    about = scene, ant_data, make_task("ant/run")
    quiet = dict(horizons=(2,), quiet=True, logger="csv")
    start = Trainer(*about, first, tmp_path / "first", **quiet).run()
    trainer = Trainer(*about, second, tmp_path / "second", init_from=start, **quiet)
    model = trainer.run().eval()
    loaded = load_checkpoint(tmp_path / "second" / "last")
    assert loaded.config == replace(start.config, copies=4)
    state = ant_data[:, 1]
    paths = []
    for one in (model, loaded, start):
        dynamics = NeRDDynamics(one)
        dynamics.reset(state)
        paths.append(dynamics.step(state, state[JOINT_TORQUE])[QVEL])
    assert torch.equal(paths[0], paths[1])
    assert not torch.equal(paths[0], paths[2])


def test_copies_are_the_sizes_of_groups(ant_data):
    scene = load_scene("ant")
    symmetry = Symmetry(scene)
    for count in (1, 2, 4, 8):
        (sources, _), (_, signs) = symmetry.group(count)
        assert len(sources) == len(signs) == count
    with pytest.raises(SettingError, match="expected copies of 1, 2, 4, 8, .* got 3"):
        symmetry.group(3)
    with pytest.raises(SettingError, match="one copy for a hybrid, got 2"):
        TrainConfig(step="unconstrained", copies=2)


def test_a_file_with_other_entries_is_refused(network):
    weights = network.state_dict()
    weights["token_sources"] = weights["token_sources"] + 3
    with pytest.raises(ValueError, match="entries 0 to 5, got entries 3 to 8"):
        network.load_state_dict(weights)


def test_a_shipped_model_with_copies_is_more_exact():
    """The same weights: from starts of the validation's seed, which no test uses."""
    model, task = from_pretrained("ant-mlp"), make_task("ant/run")
    both = [NeRDDynamics(x) for x in (model, with_copies(model, 4))]
    about = MujocoDynamics(model.scene), [100], 64, 1_000_003
    single, averaged = (passive_errors(task, x, *about)[100] for x in both)
    for name in ("base_position", "base_orientation", "joints"):
        assert averaged[name].mean < 0.95 * single[name].mean


def test_copies_of_a_model_without_symmetric_statistics_are_refused():
    with pytest.raises(ValueError, match="that was trained with use_symmetry"):
        with_copies(from_pretrained("cube-mlp"), 4)
    with pytest.raises(ValueError, match="floating base.* got 'cartpole'"):
        with_copies(from_pretrained("cartpole"), 2)
    with pytest.raises(ValueError, match="a learned model for copies, got a hybrid"):
        with_copies(from_pretrained("double_pendulum-hybrid"), 2)
