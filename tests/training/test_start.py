"""A training that begins from a checkpoint: nothing lost, nothing reinterpreted."""

import pytest
import torch
from dynamics_helpers import little_data, random_drive, random_model
from torch import Generator
from torchrl_nerd.modules.correction import ResidualConfig
from torchrl_nerd.modules.residual import ResidualNeRD

from torchrl_nerd.checkpoint import (
    from_pretrained,
    load_checkpoint,
    make_card,
    save_checkpoint,
)
from torchrl_nerd.cli import main
from torchrl_nerd.configs import TrainConfig
from torchrl_nerd.data.generate import is_sound, simulate
from torchrl_nerd.dynamics import NeRDDynamics
from torchrl_nerd.files import read_json
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.modules.networks import NETWORKS
from torchrl_nerd.robots import SCENES, load_scene
from torchrl_nerd.training import validation
from torchrl_nerd.training.augmentation import Symmetry
from torchrl_nerd.training.samples import cover, data_stats
from torchrl_nerd.training.start import begin_from, fingerprint
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
HOW = {"horizons": (2, 3), "quiet": True, "logger": "csv"}
CARTPOLE = load_scene("cartpole")


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


def other_data(scene, seed):
    data = simulate(scene, 40, 4, Generator().manual_seed(seed))
    return data[is_sound(data)]


def test_without_an_update_nothing_is_other_than_at_the_start(
    scene, tmp_path, generator
):
    start, drive = random_model(scene, generator), random_drive(scene, 4, 6, generator)
    before = fingerprint(start)
    trainer = Trainer(
        scene, little_data(scene), scene, CONFIG, tmp_path, **HOW, init_from=start
    )
    begun = trainer.averaged_model()
    assert torch.equal(path(begun, drive), path(start, drive))
    assert fingerprint(start) == before


def test_statistics_are_frozen_and_bounds_do_not_shrink(
    scene, tmp_path, generator, seed
):
    start = random_model(scene, generator)
    data = other_data(scene, seed)
    trained = Trainer(
        scene, data, scene, CONFIG, tmp_path, **HOW, init_from=start
    ).run()
    old, new = start.state_dict(), load_checkpoint(tmp_path / "last").state_dict()
    assert all(torch.equal(new[k], v) for k, v in trained.state_dict().items())
    for key, value in old.items():
        if key.startswith("normalize."):
            assert torch.equal(new[key], value)
        elif key.startswith("coverage.") and key.endswith("_low"):
            assert (new[key] <= value).all()
        elif key.startswith("coverage.") and key.endswith(("_high", "speed")):
            assert (new[key] >= value).all()
    moved = [k for k in old if k.startswith("network.") and not old[k].equal(new[k])]
    assert moved
    own = NeRD(scene, start.config)
    own.load_state_dict(old)
    cover(own, data)
    assert torch.equal(new["coverage.center"], own.coverage.center)
    card = read_json(tmp_path / "last" / "card.json")
    assert card["training"]["init_from"] == fingerprint(start)


@pytest.mark.parametrize("name", [n for n in SCENES if load_scene(n).foresees_forces])
def test_features_of_another_width_are_refused_in_a_sentence(name, generator):
    scene = load_scene(name)
    start = random_model(scene.foreseeing(False), generator)
    begin_from(start, start.scene, "transformer-2x64")
    sizes = start.tokens.size, NeRD(scene, start.config).tokens.size
    if sizes[0] != sizes[1]:
        with pytest.raises(ValueError, match=f"{sizes[1]} features.*got {sizes[0]}"):
            begin_from(start, scene, "transformer-2x64")


@pytest.mark.parametrize("name", [n for n in SCENES if load_scene(n).terrain])
def test_the_scene_is_used_as_it_is_given(name, tmp_path, generator):
    """Features of other values but the same widths: weights and statistics are kept."""
    known = load_scene(name)
    known, scene = (known.foreseeing(known.foresees_forces, x) for x in (False, True))
    start = random_model(known, generator)
    save_checkpoint(start, tmp_path, make_card(start))
    start = from_pretrained(tmp_path, scene)
    assert not start.scene.foresees_free_motion
    model = begin_from(start, scene, "transformer-2x64")
    assert model.scene is scene and scene.foresees_free_motion
    for part in ("network", "normalize"):
        mine, theirs = (getattr(m, part).state_dict() for m in (model, start))
        assert all(torch.equal(mine[k], v) for k, v in theirs.items())
    assert not model.coverage.is_fitted


def test_other_networks_are_refused(generator):
    start = random_model(CARTPOLE, generator, "mlp-4x64")
    with pytest.raises(
        ValueError, match="network.*start from, mlp-4x64, got transformer-2x64"
    ):
        begin_from(start, CARTPOLE, "transformer-2x64")
    cube = load_scene("cube_real")
    residual = ResidualNeRD(cube, ResidualConfig())
    with pytest.raises(ValueError, match="start from, ResidualConfig.*got mlp-4x64"):
        begin_from(residual, cube, "mlp-4x64")


def test_images_need_statistics_that_they_share(generator):
    scene, config = load_scene("ant"), NETWORKS["mlp-1x16"]
    data = simulate(scene, 64, 4, generator)
    data = data[is_sound(data)]
    symmetry, stats = Symmetry.of(scene, data), data_stats(scene, data)
    shared = NeRD(scene, config, symmetry.complete(stats))
    begin_from(shared, scene, "mlp-1x16", symmetry)
    alone = NeRD(scene, config, stats)
    begin_from(alone, scene, "mlp-1x16")
    with pytest.raises(ValueError, match="trained on symmetry images"):
        begin_from(alone, scene, "mlp-1x16", symmetry)


def test_the_shipped_ant_can_be_shown_images(generator):
    scene = load_scene("ant")
    model, data = from_pretrained("ant-mlp", scene), simulate(scene, 16, 4, generator)
    begin_from(model, model.scene, "mlp-4x160", Symmetry.of(model.scene, data))


ARGS = [
    "train",
    "cartpole",
    "--quiet",
    "--batch-size",
    "4",
    "--rollout-batch-size",
    "4",
]
ARGS += [
    "--steps",
    "3",
    "--rollout-steps",
    "1",
    "--sequence-length",
    "2",
    "--logger",
    "csv",
]
ARGS += ["--rollout-length", "2", "--validate-every", "4"]


def test_the_command_learns_on_from_several_sets(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(validation, "ROLLOUTS", 2)
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
        (["--data", "a", "--init-from", "none"], "checkpoint folder, got 'none'"),
        (
            ["--data", "a", "--init-from", "cartpole-micro"],
            "start from, mlp-1x16, got",
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
