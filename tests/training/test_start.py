"""A training that continues another model: nothing lost, nothing reinterpreted."""

from dataclasses import replace

import pytest
import torch
from dynamics_helpers import (
    enliven,
    hybrid_model,
    little_data,
    random_drive,
    random_model,
)
from torch import Generator

from torchrl_nerd.checkpoint import from_pretrained, load_checkpoint
from torchrl_nerd.cli import main
from torchrl_nerd.configs import NO_PREDICTIONS, TrainConfig
from torchrl_nerd.data.simulate import is_sound, simulate
from torchrl_nerd.dynamics import NeRDDynamics
from torchrl_nerd.files import read_json
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.modules.networks import NETWORKS
from torchrl_nerd.robots import load_scene
from torchrl_nerd.training import start
from torchrl_nerd.training import trainer as module
from torchrl_nerd.training.samples import cover, data_stats
from torchrl_nerd.training.start import (
    begin_from,
    find_symmetry,
    fingerprint,
    make_model,
)
from torchrl_nerd.training.symmetry import Symmetry
from torchrl_nerd.training.trainer import Trainer

CONFIG = TrainConfig(
    network="transformer-2x64",
    steps=6,
    rollout_steps=2,
    batch_size=4,
    sequence_length=3,
    rollout_batch_size=4,
    rollout_length=3,
    save_every=4,
    validate_every=8,
)
MLP = replace(CONFIG, network="mlp-1x16")
HOW = {"horizons": (2, 3), "quiet": True, "logger": "csv"}
CARTPOLE = load_scene("cartpole")

two_scenes = pytest.mark.parametrize(
    "scene", [CARTPOLE, load_scene("cube")], ids=lambda scene: scene.name
)


def path(model, drive):
    """States along the way of a model."""
    state, torques, terrain = drive
    dynamics, states = NeRDDynamics(model.eval()), []
    now = state.clone()
    dynamics.reset(now)
    for torque in torques:
        now = dynamics.step(now, torque, terrain)
        states.append(torch.cat((now["qpos"], now["qvel"]), -1))
    return torch.stack(states)


@two_scenes
def test_without_an_update_the_model_is_the_initial_one(scene, tmp_path, generator):
    initial, drive = (
        random_model(scene, generator),
        random_drive(scene, 4, 6, generator),
    )
    before, data = fingerprint(initial), little_data(scene)
    trainer = Trainer(scene, data, scene, CONFIG, tmp_path, **HOW, init_from=initial)
    assert torch.equal(path(trainer.averaged_model(), drive), path(initial, drive))
    assert fingerprint(initial) == before


@two_scenes
def test_statistics_are_frozen_and_bounds_do_not_shrink(
    scene, tmp_path, generator, seed
):
    initial = random_model(scene, generator)
    data = simulate(scene, 40, 4, Generator().manual_seed(seed))
    data = data[is_sound(data)]
    trainer = Trainer(scene, data, scene, CONFIG, tmp_path, **HOW, init_from=initial)
    trained = trainer.run()
    old, new = initial.state_dict(), load_checkpoint(tmp_path / "last").state_dict()
    assert all(torch.equal(new[k], v) for k, v in trained.state_dict().items())
    for key, value in old.items():
        if key.startswith("normalize."):
            assert torch.equal(new[key], value)
        elif key.startswith("training_range.") and key.endswith("_low"):
            assert (new[key] <= value).all()
        elif key.startswith("training_range.") and key.endswith(("_high", "speed")):
            assert (new[key] >= value).all()
    assert any(not old[k].equal(new[k]) for k in old if k.startswith("network."))
    own = NeRD(scene, NO_PREDICTIONS, initial.config)
    own.load_state_dict(old)
    cover(own, data)
    scores = [k for k in old if k.startswith("ood.")]
    assert scores and all(torch.equal(new[k], own.state_dict()[k]) for k in scores)
    card = read_json(tmp_path / "last" / "card.json")
    assert card["training"]["init_from"] == fingerprint(initial)


def test_features_of_another_width_are_refused_in_a_sentence(generator):
    scene = load_scene("ant")
    initial = random_model(scene, generator, "mlp-1x16")
    assert begin_from(initial, scene, MLP).token_size == initial.token_size
    with pytest.raises(ValueError, match=f"inputs and .*got {initial.token_size} and"):
        begin_from(initial, scene, replace(MLP, predicted_force=True))
    with pytest.raises(ValueError, match="from features .*unconstrained_motion=True"):
        begin_from(initial, scene, replace(MLP, unconstrained_motion=True))


def test_a_model_in_half_precision_has_a_fingerprint(generator):
    model = random_model(CARTPOLE, generator, "mlp-1x16")
    before = fingerprint(model)
    model.network.to(torch.bfloat16)
    assert fingerprint(model) != before


def test_other_networks_and_kinds_are_refused(generator):
    initial = random_model(CARTPOLE, generator, "mlp-4x64")
    with pytest.raises(ValueError, match="start from, mlp-4x64, got transformer-2x64"):
        begin_from(initial, CARTPOLE, CONFIG)
    with pytest.raises(ValueError, match="expected a hybrid model.*got a learned one"):
        step = replace(CONFIG, network="mlp-4x64", step="unconstrained")
        begin_from(initial, CARTPOLE, step)
    hybrid = hybrid_model(CARTPOLE, None, generator)
    name = next(name for name, config in NETWORKS.items() if config == hybrid.config)
    with pytest.raises(ValueError, match="expected a learned model.*got a hybrid one"):
        begin_from(hybrid, CARTPOLE, replace(CONFIG, network=name))


@pytest.mark.parametrize("name", ["cartpole", "ant"])
def test_a_longer_band_begins_where_the_shorter_one_is(name, generator, monkeypatch):
    """Shut out, new tokens change nothing; else they count for little."""
    scene = load_scene(name)
    initial = random_model(scene, generator, "transformer-2x64@4")
    drive = random_drive(scene, 4, 12, generator)
    expected, config = (
        path(initial, drive),
        replace(CONFIG, network="transformer-2x64@9"),
    )
    apart = []
    for far in (start.FAR, float("-inf")):
        monkeypatch.setattr(start, "FAR", far)
        model = begin_from(initial, scene, config)
        model.training_range.load_state_dict(initial.training_range.state_dict())
        assert model.config.band == 9 and initial.config.band == 4
        apart.append((path(model, drive) - expected).abs().amax((1, 2)))
    assert (apart[0][4:] > apart[1][4:]).all() and (apart[1] < 1e-4).all()
    with pytest.raises(ValueError, match="from, transformer-2x64@9, got .*2x64@4"):
        begin_from(model, scene, replace(CONFIG, network="transformer-2x64@4"))


@pytest.mark.parametrize(
    ("name", "asked"),
    [
        ("mlp-4x128", "mlp-4x128-products"),
        ("transformer-4x128@5", "transformer-4x128-products@5"),
    ],
)
def test_products_add_nothing_at_first(name, asked, generator):
    initial = random_model(CARTPOLE, generator, name)
    drive = random_drive(CARTPOLE, 4, 12, generator)
    config = replace(CONFIG, network=asked)
    model = begin_from(initial, CARTPOLE, config)
    model.training_range.load_state_dict(initial.training_range.state_dict())
    assert torch.equal(path(model, drive), path(initial, drive))
    enliven(model, generator)
    again = begin_from(model, CARTPOLE, config)  # those that it has are kept
    again.training_range.load_state_dict(model.training_range.state_dict())
    assert torch.equal(path(again, drive), path(model, drive))
    with pytest.raises(ValueError, match="network of the model to start from"):
        begin_from(model, CARTPOLE, replace(config, network=name))


def test_mirrors_that_some_varied_robots_lack_are_refused(generator):
    """Whichever two commute: one of the start's may be no symmetry of the scene."""
    scene = load_scene("ant")
    config = replace(MLP, symmetries=2)
    first = Symmetry(scene)
    stats = first.complete(data_stats(scene, little_data(scene)))
    initial = make_model(scene, config, stats, first)
    whole = scene.vary({"motor": (0.6, 1.2)})
    begin_from(initial, whole, config, Symmetry(whole))
    one_leg = scene.vary({"damping:hip_1": (0.0, 5.0)})
    with pytest.raises(ValueError, match="whose mirrors all robots of 'ant' have"):
        begin_from(initial, one_leg, config, Symmetry(one_leg))


def test_a_told_model_goes_on_with_the_parameters_that_it_knows(generator):
    first, second = {"mass:pole": (0.3, 3.0)}, {"motor": (0.6, 1.4)}
    scene, config = CARTPOLE.vary(first | second), replace(MLP, parameters=True)
    initial = make_model(scene, config)
    begin_from(initial, scene, config)
    with pytest.raises(ValueError, match="expected the parameters .* is told"):
        begin_from(initial, CARTPOLE.vary(second | first), config)


@pytest.mark.parametrize(
    ("name", "how", "count"),
    [
        ("gymnasium/Walker2d-v5", {}, 2),
        ("gymnasium/Ant-v5", {}, 4),
        ("gymnasium/Walker2d-v5", {"network": "gru"}, 1),
        ("cartpole", {"step": "unconstrained"}, 1),
        ("double_pendulum", {}, 1),
        ("gymnasium/Hopper-v5", {}, 1),
        ("gymnasium/Humanoid-v5", {"near_symmetry": True}, 2),
        ("gymnasium/Humanoid-v5", {"use_symmetry": True}, 1),
        ("gymnasium/Walker2d-v5", {"symmetries": 1}, 1),
    ],
)
def test_a_number_of_symmetries_that_is_left_open_is_the_largest(name, how, count):
    asked = {key: value for key, value in how.items() if key != "near_symmetry"}
    scene, config = load_scene(name), replace(MLP, **{"symmetries": 0} | asked)
    found, symmetry = find_symmetry(scene, config)
    assert found == replace(config, **{"symmetries": count} | how)
    assert (symmetry is None) == (count == 1 and not config.use_symmetry)
    if count > 1:  # whoever goes on has that of the start
        plain = make_model(scene, replace(config, symmetries=1))
        first = make_model(scene, found, None, symmetry)
        assert find_symmetry(scene, config, plain)[0].symmetries == 1
        assert find_symmetry(scene, config, first)[0] == found


def test_a_third_party_robot_has_its_symmetries_and_resumes(tmp_path, capsys):
    line = f"train gymnasium/Walker2d-v5 --data {tmp_path}/data --out {tmp_path}/run"
    small = "--network mlp-1x16 --steps 3 --rollout-steps 0 --batch-size 4 --quiet"
    drawn = f"data gymnasium/Walker2d-v5 --trajectories 4 --out {tmp_path}/data --quiet"
    assert main(drawn.split()) == 0
    capsys.readouterr()
    assert main(f"{line} {small} --dry-run".split()) == 0
    assert (
        "of a learned model with symmetries 2 for 3 updates" in capsys.readouterr().out
    )
    for _ in range(2):
        assert main(f"{line} {small}".split()) == 0
    assert read_json(tmp_path / "run" / "state.json")["config"]["symmetries"] == 2
    model = load_checkpoint(tmp_path / "run" / "last")
    assert model.config.symmetries == 2


def test_symmetry_needs_statistics_that_copies_share(generator):
    scene, network = load_scene("ant"), NETWORKS["mlp-1x16"]
    data = simulate(scene, 64, 4, generator)
    data = data[is_sound(data)]
    symmetry, stats = Symmetry(scene), data_stats(scene, data)
    shared = NeRD(scene, NO_PREDICTIONS, network, symmetry.complete(stats))
    begin_from(shared, scene, MLP, symmetry)
    alone = NeRD(scene, NO_PREDICTIONS, network, stats)
    begin_from(alone, scene, MLP)
    with pytest.raises(ValueError, match="trained with use_symmetry"):
        begin_from(alone, scene, MLP, symmetry)


ARGS = (
    "train cartpole --quiet --batch-size 4 --rollout-batch-size 4 --steps 3 "
    "--rollout-steps 1 --sequence-length 2 --rollout-length 2 --validate-every 4 "
    "--logger csv"
).split()


def test_the_command_continues_from_several_data_sets(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(module, "ROLLOUTS", 2)
    for out, seed in (("a", "1"), ("b", "2")):
        sizes = ["--trajectories", "9", "--steps", "110", "--seed", seed, "--quiet"]
        assert main(["data", "cartpole", "--out", out, *sizes]) == 0
    argv = [*ARGS, "--data", "a", "b", "--init-from", "cartpole", "--out", "on"]
    assert main([*argv, "--dry-run"]) == 0
    assert "use the data in a, b" in capsys.readouterr().out
    assert main(argv) == main(argv) == 0
    training = read_json(tmp_path / "on" / "last" / "card.json")["training"]
    assert training["trajectories"] == 18
    assert training["init_from"] == fingerprint(from_pretrained("cartpole"))
    assert main([*ARGS, "--data", "a", "--init-from", "on/last", "--dry-run"]) == 0
    capsys.readouterr()
    for options, words in (
        (
            ["--data", "a", "--init-from", "ant"],
            "is for robot 'ant', expected 'cartpole'",
        ),
        (["--data", "a", "--init-from", "none"], "unknown dynamics 'none', expected"),
        (
            ["--data", "a", "--init-from", "cartpole-mlp"],
            "start from, mlp-1x32, got",
        ),
        (["--data", "a", "none"], "expected a data set in none"),
        (
            ["--data", "a", "--init-from", "on/last", "--out", "on"],
            "run with init_from",
        ),
    ):
        assert main([*ARGS, "--out", "new", *options]) == 2
        said = capsys.readouterr().err
        assert words in said and said.count("\n") == 1
