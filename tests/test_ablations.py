"""Every variant predicts the true next state, trains, and differs in what it says."""

import pytest
import torch
from ablations import measure
from ablations.__main__ import Options, main
from ablations.networks import LSTMConfig, MarkovConfig
from ablations.training import VariantTrainer
from ablations.variants import BASE, VARIANTS
from helpers import moved_rows, random_transitions, slow_but
from tensordict import TensorDict

from torchrl_nerd.data.generate import is_sound, simulate
from torchrl_nerd.geometry.manifold import differentiate_pos
from torchrl_nerd.geometry.rotations import quat_conjugate, quat_multiply
from torchrl_nerd.keys import (
    CONTACT_NORMAL,
    JOINT_TORQUE,
    NEXT_QPOS,
    NEXT_QVEL,
    QPOS,
    QVEL,
    TERRAIN,
)
from torchrl_nerd.modules.nerd import TARGET, TOKEN
from torchrl_nerd.robots import load_scene, source_of
from torchrl_nerd.training.samples import raw_tokens

VARIANTS_OF = [
    (scene, name) for scene, variants in VARIANTS.items() for name in variants
]
every_variant = pytest.mark.parametrize(("name", "variant"), VARIANTS_OF)
UPDATES = 48  # a quarter of them, by chance, on sequences
UNMOVED = {  # whether a variant of the Ant knows where it stands
    name: name not in ("world frame", "end to end") for name in VARIANTS["ant"]
}


def built(name: str, variant: str, data: TensorDict):
    return VARIANTS[name][variant].build(load_scene(name), data)


def encoded(model, rows: TensorDict):
    return raw_tokens(model.scene_features, model.state_delta, rows)


@every_variant
def test_the_true_target_leads_to_the_true_next_state(name, variant, generator):
    scene = load_scene(name)
    rows = random_transitions(scene, 64, generator)
    model = built(name, variant, rows)
    token, target = encoded(model, rows)
    assert token.shape == (64, model.scene_features.size)
    assert target.shape == (64, model.state_delta.size)
    output = model.normalize.normalize(TARGET, target)
    state = rows[QPOS], rows[QVEL]
    seen = model.encode(*state, rows[JOINT_TORQUE], rows.get(TERRAIN, None))
    qpos, qvel = model.decode(state, seen, output)
    off = differentiate_pos(scene.layout, rows[NEXT_QPOS], qpos)
    torch.testing.assert_close(off, torch.zeros_like(off), atol=1e-10, rtol=0.0)
    torch.testing.assert_close(qvel, rows[NEXT_QVEL], atol=1e-10, rtol=0.0)


@pytest.mark.parametrize(("name", "variant"), slow_but([("ant", BASE)], VARIANTS_OF))
def test_it_trains(name, variant, seed, generator, tmp_path):
    scene = load_scene(name)
    data = simulate(scene, 3, 40, generator)
    data = data[is_sound(data)]
    source = source_of(scene)
    parts = VARIANTS[name][variant], scene, data, source, tmp_path
    trainer = VariantTrainer(*parts, updates=UPDATES, seed=seed)
    before = [weight.clone() for weight in trainer.model.network.parameters()]
    trainer.run()
    after = trainer.model.network.parameters()
    pairs = zip(before, after, strict=True)
    changed = [not torch.equal(old, new) for old, new in pairs]
    # of a bias that nothing is added to but itself, softmax leaves no gradient
    assert all(changed) or variant == "h = 1" and sum(changed) > len(changed) / 2
    raw = VARIANTS[name][variant].raw
    for key in (TOKEN, TARGET):
        assert (trainer.model.normalize.mean(key) == 0.0).all() == (key in raw)


@pytest.mark.parametrize(("variant", "unmoved"), UNMOVED.items())
def test_only_the_world_frame_knows_where_the_robot_is(variant, unmoved, generator):
    scene = load_scene("ant")
    rows = random_transitions(scene, 16, generator)
    yaw = 1.0 + float(torch.rand((), generator=generator))
    shift = torch.tensor([3.0, -4.0, 0.0]).double()
    moved = moved_rows(scene, rows, yaw, shift)
    model = built("ant", variant, rows)
    pairs = zip(encoded(model, rows), encoded(model, moved), strict=True)
    for here, there in pairs:
        assert torch.allclose(here, there, atol=1e-9) == unmoved


def test_targets_are_what_they_are_called(generator):
    rows = random_transitions(load_scene("ant"), 16, generator)
    change = rows[NEXT_QVEL] - rows[QVEL]
    found = {
        name: encoded(built("ant", name, rows), rows)[1]
        for name in ("world frame", "absolute", "no trapezoid", "quaternion")
    }
    nv = change.shape[-1]
    world, absolute = found["world frame"], found["absolute"]
    torch.testing.assert_close(world[:, :3], change[:, :3])
    torch.testing.assert_close(absolute[:, 6:nv], rows[NEXT_QVEL][:, 6:])
    torch.testing.assert_close(absolute[:, nv + 6 :], rows[NEXT_QPOS][:, 7:])
    moved = rows[NEXT_QPOS][:, 7:] - rows[QPOS][:, 7:]
    torch.testing.assert_close(found["no trapezoid"][:, nv + 6 :], moved)
    quats = (x[:, 3:7] for x in (rows[QPOS], rows[NEXT_QPOS]))
    before, after = quats
    turn = quat_multiply(quat_conjugate(before), after)
    torch.testing.assert_close(found["quaternion"][:, -4:], turn)


def test_end_to_end_sees_no_ground_and_a_link_frame_turns_it(generator):
    scene = load_scene("double_pendulum")
    rows = random_transitions(scene, 64, generator)
    other = rows.clone()
    other[TERRAIN] = rows[TERRAIN].roll(1, 0)
    models = {
        name: built("double_pendulum", name, rows)
        for name in (BASE, "end to end", "link frame")
    }
    seen = {name: encoded(model, rows)[0] for name, model in models.items()}
    assert torch.equal(seen["end to end"], encoded(models["end to end"], other)[0])
    assert not torch.equal(seen[BASE], encoded(models[BASE], other)[0])
    width = models[BASE].scene_features.contact.sizes[CONTACT_NORMAL]
    here, there = (
        seen[name][:, -width:].unflatten(-1, (-1, 3)) for name in (BASE, "link frame")
    )
    angle = rows[QPOS][:, 0, None]  # the first hinge turns about y, from x to -z
    sine, cosine = angle.sin(), angle.cos()
    x, y, z = here.unbind(-1)
    turned = torch.stack((cosine * x + sine * z, y, cosine * z - sine * x), -1)
    back = torch.stack((cosine * x - sine * z, y, cosine * z + sine * x), -1)
    fits = [torch.allclose(there, way, atol=1e-9) for way in (turned, back)]
    assert any(fits) and not torch.allclose(there, here)


@pytest.mark.parametrize("config", [LSTMConfig(8), MarkovConfig(2, 8, 2)])
def test_step_by_step_is_the_sequence(config, generator):
    network = config.build(3, 2).double()
    tokens = torch.randn(4, 6, 3, dtype=torch.float64, generator=generator)
    whole, memory = network(tokens), network.empty_memory(4)
    steps = [network.step(tokens[:, step], memory) for step in range(6)]
    torch.testing.assert_close(torch.stack(steps, 1), whole)
    rows = torch.tensor([True, False, True, False])
    memory.clear(rows)
    again = network.step(tokens[:, 0], memory)
    torch.testing.assert_close(again[rows], whole[rows, 0])
    is_alone = isinstance(config, MarkovConfig)
    assert torch.allclose(again[~rows], whole[~rows, 0]) == is_alone


def test_one_token_is_a_transformer_without_a_past(generator):
    network = MarkovConfig(2, 8, 2).build(3, 2)
    token = torch.randn(4, 3, generator=generator)
    transformer = network.transformer
    alone = transformer.step(token, transformer.empty_memory(4))
    torch.testing.assert_close(network(token), alone)


@pytest.mark.slow
def test_the_command_writes_its_table_and_reads_what_is_done(
    seed, tmp_path, monkeypatch, capsys
):
    tried = BASE, "absolute", "no trapezoid"
    options = Options(variants=tried[1:], seeds=(0, 1), out=tmp_path)
    options.trajectories, options.updates, options.rows = 12, 1, 2
    options.test_seed = seed
    monkeypatch.setattr(measure, "MOST_STEPS", 3)
    found = main(options)
    table = capsys.readouterr().out
    for name, runs in found.items():
        assert [(run["seed"], run["variant"]) for run in runs] == [
            (seed, variant) for seed in (0, 1) for variant in tried
        ]
        for row in tried:
            assert f"| {row} | " in table
        for ending in ("md", "json", "png"):
            assert (tmp_path / f"ablations_{name}.{ending}").exists()
    monkeypatch.setattr(measure, "VariantTrainer", None)  # nothing is trained again
    assert main(options) == found
    options.updates = 2
    with pytest.raises(TypeError):
        main(options)
