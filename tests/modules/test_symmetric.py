"""Networks that have the mirror symmetries of their robot, whatever their weights."""

import copy
from dataclasses import replace

import pytest
import torch
from dynamics_helpers import enliven
from torch import Tensor, nn

from torchrl_nerd.checkpoint import load_checkpoint
from torchrl_nerd.configs import TrainConfig
from torchrl_nerd.data.simulate import is_sound, simulate
from torchrl_nerd.dynamics import NeRDDynamics
from torchrl_nerd.geometry.rotations import orientation_error
from torchrl_nerd.keys import JOINT_TORQUE, QPOS, QVEL
from torchrl_nerd.modules.networks import MLPConfig
from torchrl_nerd.modules.symmetric import SignedCopies, block_product, set_mirrors
from torchrl_nerd.modules.transformer import TransformerConfig
from torchrl_nerd.modules.walsh import transform, walsh_signs
from torchrl_nerd.robots import load_scene, make_task
from torchrl_nerd.settings import SettingError
from torchrl_nerd.training.optimizers import split_parameters
from torchrl_nerd.training.samples import data_stats
from torchrl_nerd.training.start import make_model
from torchrl_nerd.training.symmetry import Symmetry
from torchrl_nerd.training.trainer import Trainer

INPUTS, OUTPUTS, ROWS, STEPS = 6, 4, 5, 9
CONFIGS = {
    "mlp": MLPConfig(2, 16),
    "transformer": TransformerConfig(2, 16, 2, 3),
    "wide band": TransformerConfig(2, 16, 2, 17),
    "pairs": TransformerConfig(2, 16, 2, 3, pairs=True),
    "products": TransformerConfig(2, 16, 2, 3, pairs=True, products=True),
    "mlp with products": MLPConfig(2, 16, products=True),
}
# three mirrors that commute: two swap entries, and each flips others
MIRRORS = (
    ([1, 0, 2, 3, 4, 5], [1.0, 1.0, -1.0, 1.0, 1.0, -1.0]),
    ([0, 1, 3, 2, 4, 5], [-1.0, -1.0, 1.0, 1.0, 1.0, 1.0]),
    ([0, 1, 2, 3, 4, 5], [1.0, 1.0, 1.0, 1.0, -1.0, 1.0]),
)
# the first one flips the third entry, which the second one swaps with the fourth
MIRRORS[0][1][3] = -1.0


def products(count: int, size: int) -> SignedCopies:
    """Of the first of `MIRRORS`, as `SignedPermutations.mirrors` orders them."""
    sources, signs = [torch.arange(size)], [torch.ones(size)]
    for source, sign in MIRRORS[: count.bit_length() - 1]:
        one, flip = torch.tensor(source)[:size], torch.tensor(sign)[:size]
        before = list(zip(sources, signs, strict=True))
        sources += [earlier[one] for earlier, _ in before]
        signs += [flip * sign[one] for _, sign in before]
    return torch.stack(sources), torch.stack(signs)


def mirrored(x: Tensor, mirrors: SignedCopies, number: int) -> Tensor:
    return x[..., mirrors[0][number]] * mirrors[1][number].to(x.dtype)


@pytest.fixture(params=[(name, n) for name in CONFIGS for n in (2, 8)], ids=str)
def network(request, generator) -> nn.Module:
    name, count = request.param
    config = replace(CONFIGS[name], symmetries=count)
    network = enliven(config.build(INPUTS, OUTPUTS), generator)
    set_mirrors(network, products(count, INPUTS), products(count, OUTPUTS))
    return network.double()


@pytest.fixture
def tokens(generator) -> Tensor:
    return torch.randn(ROWS, STEPS, INPUTS, dtype=torch.float64, generator=generator)


def apart(network: nn.Module, tokens: Tensor) -> list[float]:
    """How far outputs of mirrored tokens are from mirrored outputs, for every mirror."""
    count, here = network.config.symmetries, network(tokens)
    inputs, outputs = products(count, INPUTS), products(count, OUTPUTS)
    pairs = (
        (network(mirrored(tokens, inputs, k)), mirrored(here, outputs, k))
        for k in range(count)
    )
    return [float((there - expected).abs().max()) for there, expected in pairs]


@torch.no_grad()
def test_mirrored_tokens_give_mirrored_outputs(network, tokens):
    assert max(apart(network, tokens)) < 1e-12 * float(network(tokens).abs().max())
    other = products(network.config.symmetries, INPUTS)
    unsigned = other[0], torch.ones_like(other[1])  # the wrong mirrors: not symmetric
    set_mirrors(network, unsigned, products(network.config.symmetries, OUTPUTS))
    assert max(apart(network, tokens)) > 1e-3


@torch.no_grad()
@pytest.mark.parametrize("name", CONFIGS)
def test_an_asymmetry_is_zero_at_first_and_tells_mirrors_apart(name, tokens, generator):
    config = replace(CONFIGS[name], symmetries=4, asymmetry=True)
    network = config.build(INPUTS, OUTPUTS)
    assert not network.embed.asymmetry.any()
    enliven(network, generator).double()
    set_mirrors(network, products(4, INPUTS), products(4, OUTPUTS))
    assert min(apart(network, tokens)[1:]) > 1e-3
    plain = replace(config, asymmetry=False).build(INPUTS, OUTPUTS).double()
    weights = network.state_dict()
    weights.pop("embed.asymmetry")
    plain.load_state_dict(weights)
    network.embed.asymmetry.zero_()
    assert torch.equal(network(tokens), plain(tokens))
    assert max(apart(network, tokens)) < 1e-12 * float(network(tokens).abs().max())


@torch.no_grad()
def test_stepping_equals_the_full_sequence_and_rows_forget_alone(network, tokens):
    rows, memory = torch.arange(ROWS) % 2 == 1, network.empty_memory(ROWS)
    outputs = []
    for step, token in enumerate(tokens.unbind(1)):
        if step == 4:
            memory.clear(rows)
        outputs.append(network.step(token, memory))
    streamed = torch.stack(outputs, 1)
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


@pytest.mark.parametrize(
    "network",
    [
        ("mlp", 8),
        ("pairs", 2),
        *(
            pytest.param((name, 2), marks=pytest.mark.slow)
            for name in CONFIGS
            if name != "pairs"
        ),
    ],
    indirect=True,
    ids=str,
)
@torch.no_grad()
def test_a_step_is_one_graph(network, tokens):
    traced = torch.compile(network.step, backend="eager", fullgraph=True)
    memories = [network.empty_memory(ROWS) for _ in range(2)]
    for token in tokens[:, :3].unbind(1):
        expected = network.step(token, memories[0])
        torch.testing.assert_close(traced(token, memories[1]), expected)


@torch.no_grad()
def test_inner_matrices_may_be_bfloat16(network, tokens):
    network, tokens = network.float(), tokens.float()
    expected, size = network(tokens), 0.05 * network(tokens).abs().max()
    with torch.autocast("cpu", torch.bfloat16):
        cast = network(tokens)
    assert cast.dtype == torch.float32
    assert (cast - expected).abs().max() < size
    rounded = network.to(torch.bfloat16)
    ends = rounded.embed.weight, rounded.head[0].weight, rounded.head[-1].weight
    assert {x.dtype for x in ends} == {torch.float32}
    assert rounded.blocks[0].expand.weight.dtype == torch.bfloat16
    found = rounded(tokens)
    assert found.dtype == torch.float32 and not torch.equal(found, expected)
    assert (found - expected).abs().max() < size


def test_blocks_have_a_share_of_the_products_and_are_matrices_of_muon(network):
    count = network.config.symmetries
    plain = replace(network.config, symmetries=1).build(INPUTS, OUTPUTS)
    for name in ("expand", "contract"):
        blocks, whole = (getattr(x.blocks[0], name).weight for x in (network, plain))
        assert blocks.numel() * count == whole.numel()
    others = {id(x) for x in split_parameters(network)[1]}
    names = {name for name, x in network.named_parameters() if id(x) in others}
    assert {name.split(".")[-1] for name in names} <= {"bias", "offset_bias"}


@pytest.mark.parametrize("order", [2, 4, 8])
def test_the_transform_is_orthogonal_and_tells_blocks_apart(order, generator):
    signs = walsh_signs(order)
    gram = signs.double() @ signs.double()
    torch.testing.assert_close(gram, order * torch.eye(order, dtype=torch.float64))
    x = torch.randn(3, order, 5, dtype=torch.float64, generator=generator)
    torch.testing.assert_close(transform(transform(x, signs), signs), x)
    # what permutes parts by k flips the signs of characters
    for k in range(order):
        permuted = x[:, torch.arange(order) ^ k]
        expected = transform(x, signs) * signs[k][:, None]
        torch.testing.assert_close(transform(permuted, signs), expected)
    weight = torch.randn(order, 4, 5, dtype=torch.float64, generator=generator)
    whole = torch.block_diag(*weight)
    flat = x.flatten(1) @ whole.mT
    torch.testing.assert_close(block_product(x, weight).flatten(1), flat)


@pytest.fixture(scope="module")
def ant_data():
    data = simulate(load_scene("ant"), 60, 8, torch.Generator().manual_seed(0))
    return data[is_sound(data)]


@pytest.mark.parametrize("name", ["mlp-2x32", "transformer-2x64"])
@pytest.mark.parametrize(
    ("robot", "most"), [("ant", 4), ("cartpole", 2), ("dm_control/walker-walk", 2)]
)
@torch.no_grad()
def test_a_step_has_the_mirrors_of_its_robot(robot, most, name, generator):
    """Within the training range, of which the network knows the copies alike."""
    scene = load_scene(robot)
    data = simulate(scene, 60, 8, generator)
    data = data[is_sound(data)]
    symmetry = Symmetry(scene)
    stats = symmetry.complete(data_stats(scene, data))
    state, gaps = data[:, 3], {}
    numbers = symmetry.targets.mirrors(most)
    assert numbers is not None
    for count in (1, most):
        config = TrainConfig(network=name, symmetries=count)
        model = make_model(scene, config, stats, symmetry).eval()
        enliven(model.network, generator)
        dynamics = NeRDDynamics(model)

        def stepped(start, dynamics=dynamics):
            dynamics.reset(start)
            return dynamics.step(start, start[JOINT_TORQUE])

        there, found = stepped(state), []
        for isometry in (symmetry.isometries[k] for k in numbers):
            mirror, expected = stepped(isometry(state)), isometry(there)
            found.append((mirror[QVEL] - expected[QVEL]).abs().max())
            if scene.base.is_floating:
                turned = (x[QPOS][:, 3:7] for x in (mirror, expected))
                found.append(orientation_error(*turned).max())
        change = (there[QVEL] - state[QVEL]).abs().max()
        gaps[count] = float(max(found) / change)
    assert gaps[most] < 1e-4 < gaps[1]


def test_it_is_trained_saved_loaded_and_trained_on(ant_data, tmp_path):
    """On single steps and on rollouts, with the other symmetries shown as data."""
    scene, how = load_scene("ant"), dict(network="mlp-1x16", use_symmetry=True)
    sizes = dict(batch_size=8, sequence_length=2, rollout_batch_size=4, steps=2)
    first = TrainConfig(rollout_steps=0, symmetries=4, **how | sizes)
    second = replace(first, rollout_steps=2, rollout_length=2)
    about = scene, ant_data, make_task("ant/run")
    quiet = dict(horizons=(2,), quiet=True, logger="csv")
    start = Trainer(*about, first, tmp_path / "first", **quiet).run()
    trainer = Trainer(*about, second, tmp_path / "second", init_from=start, **quiet)
    model = trainer.run().eval()
    loaded = load_checkpoint(tmp_path / "second" / "last")
    assert loaded.config == start.config == MLPConfig(1, 16, symmetries=4)
    (sources, signs), center = Symmetry(scene).tokens.copies, loaded.ood.center
    torch.testing.assert_close(signs * center[sources], center.expand_as(signs))
    state, paths = ant_data[:, 1], []
    for one in (model, loaded, start):
        dynamics = NeRDDynamics(one)
        dynamics.reset(state)
        paths.append(dynamics.step(state, state[JOINT_TORQUE])[QVEL])
    assert torch.equal(paths[0], paths[1])
    assert not torch.equal(paths[0], paths[2])
    plain = replace(second, symmetries=1)
    with pytest.raises(ValueError, match="mlp-1x16 with symmetries 4, got mlp-1x16$"):
        Trainer(*about, plain, tmp_path / "plain", init_from=start, **quiet)
    near = replace(second, use_symmetry=False, near_symmetry=True)
    with pytest.raises(
        ValueError, match="symmetries 4, got mlp-1x16 with nearly symmetries 4$"
    ):
        Trainer(*about, near, tmp_path / "near", init_from=start, **quiet)


def test_a_robot_that_is_nearly_symmetric_learns_how_it_is_not(tmp_path):
    """The left knee of Gymnasium's Humanoid has a spring, the right one has none."""
    scene = load_scene("gymnasium/Humanoid-v5")
    sizes = dict(batch_size=8, sequence_length=1, steps=3, rollout_steps=0)
    config = TrainConfig("mlp-1x16", symmetries=2, near_symmetry=True, **sizes)
    data = simulate(scene, 20, 20, torch.Generator().manual_seed(0))
    about = scene, data[is_sound(data)], scene, config, tmp_path / "run"
    model = Trainer(*about, horizons=(2,), quiet=True, logger="csv").run().eval()
    loaded = load_checkpoint(tmp_path / "run" / "last", scene)
    assert loaded.config == MLPConfig(1, 16, symmetries=2, asymmetry=True)
    assert loaded.network.embed.asymmetry.all()
    state = data[:, 1]
    steps = [NeRDDynamics(x).step(state, state[JOINT_TORQUE]) for x in (model, loaded)]
    assert torch.equal(steps[0][QVEL], steps[1][QVEL])
    with pytest.raises(SettingError, match="symmetries 1, the .* got 2"):
        make_model(scene, replace(config, near_symmetry=False), None, Symmetry(scene))


@pytest.mark.parametrize("name, most", [("ant", 4), ("cube", 8)])
def test_symmetries_are_products_of_commuting_mirrors(name, most):
    symmetry = Symmetry(load_scene(name))
    for count in (2**n for n in range(most.bit_length())):
        for sources, signs in symmetry.mirrors(count):
            assert sources.shape == signs.shape and len(sources) == count
            for k in range(count):
                for other in range(count):  # numbers multiply as their bits do
                    after = sources[other][sources[k]]
                    flips = signs[k] * signs[other][sources[k]]
                    assert torch.equal(after, sources[k ^ other])
                    assert torch.equal(flips, signs[k ^ other])
    sizes = " or ".join(str(2**n) for n in range(most.bit_length()))
    assert " or ".join(map(str, symmetry.counts())) == sizes
    with pytest.raises(SettingError, match=f"symmetries {sizes}, the .* got 16"):
        symmetry.mirrors(16)


def test_symmetries_that_no_network_has_are_refused(ant_data):
    scene = load_scene("ant")
    with pytest.raises(SettingError, match="1 of symmetries for a hybrid, got 2"):
        TrainConfig(step="unconstrained", symmetries=2)
    for how in (
        {"near_symmetry": True},
        {"near_symmetry": True, "symmetries": 2, "use_symmetry": True},
    ):
        with pytest.raises(SettingError, match="expected near_symmetry with symmetr"):
            TrainConfig(**how)
    with pytest.raises(SettingError, match="or an MLP with symmetries, got 'gru'"):
        make_model(scene, TrainConfig(network="gru", symmetries=2))
    for width, count in ((16, 3), (16, -4), (128, 128)):
        with pytest.raises(
            ValueError, match=f"divides width {width} and .* got {count}"
        ):
            MLPConfig(1, width, symmetries=count).build(INPUTS, OUTPUTS)
    with pytest.raises(ValueError, match="hinges or slides.* got 'double_pendulum'"):
        Symmetry(load_scene("double_pendulum"))


@pytest.mark.parametrize(
    ("key", "change", "said"),
    [
        (
            "embed.sources",
            lambda x: x + 3,
            "every entry from 0 to 5 once, got .3, 4, 5",
        ),
        (
            "embed.sources",
            lambda x: 0 * x,
            "every entry from 0 to 5 once, got .0, 0, 0",
        ),
        (
            "embed.entry_signs",
            lambda x: 2 * x,
            "signs 1 or -1 of mirrored entries, got",
        ),
        (
            "embed.entry_signs",
            lambda x: x / 0,
            "signs 1 or -1 of mirrored entries, got",
        ),
    ],
)
def test_a_file_with_other_mirrors_is_refused(network, key, change, said):
    weights = network.state_dict()
    weights[key] = change(weights[key])
    with pytest.raises(ValueError, match=said):
        network.load_state_dict(weights)
