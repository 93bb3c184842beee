"""Training: the loss falls on every robot, and bad requests are refused in a sentence."""

from dataclasses import replace
from functools import cache
from itertools import cycle
from pathlib import Path

import pytest
import torch
from helpers import slow_but
from tensordict import TensorDict
from torch import Generator, nn

from torchrl_nerd.checkpoint import load_checkpoint
from torchrl_nerd.configs import TrainConfig
from torchrl_nerd.data.simulate import is_sound, simulate
from torchrl_nerd.dynamics import NeRDDynamics
from torchrl_nerd.evaluation.rollout_error import initial_states, open_loop
from torchrl_nerd.files import read_json
from torchrl_nerd.modules.networks import NETWORKS
from torchrl_nerd.robots import PRESETS, SCENES, load_scene, make_task
from torchrl_nerd.scenes import Scene
from torchrl_nerd.training.log import TrainingLog
from torchrl_nerd.training.losses import one_step_loss
from torchrl_nerd.training.muon import Muon
from torchrl_nerd.training.optimizers import (
    follow_gradient,
    learning_rate_ratio,
    make_adamw,
    split_parameters,
)
from torchrl_nerd.training.trainer import Trainer

SCENE, OTHER = (load_scene(name) for name in ("cartpole", "double_pendulum"))
BRIEF = TrainConfig(
    steps=40,
    rollout_steps=5,
    batch_size=32,
    sequence_length=8,
    rollout_batch_size=8,
    rollout_length=4,
    warmup=5,
    save_every=15,
    validate_every=20,
)


NETWORK_NAMES = ("mlp-4x64", "transformer-2x64", "gru")
CASES = [(list(SCENES)[0], name) for name in NETWORK_NAMES]
CASES += list(zip(list(SCENES)[1:], cycle(NETWORK_NAMES), strict=False))
"""Every network on one scene, and every scene with one network."""


@cache
def trajectories(scene: Scene, steps: int) -> TensorDict:
    data = simulate(scene, 200, steps, Generator().manual_seed(0))
    return data[is_sound(data)]


def make_trainer(scene: Scene, config: TrainConfig, folder: Path, steps=12) -> Trainer:
    task, data = make_task(PRESETS[scene.name].task), trajectories(scene, steps)
    return Trainer(scene, data, task, config, folder, horizons=(2, 5), quiet=True)


def loss_of(trainer: Trainer, seed: int) -> float:
    generator = Generator().manual_seed(seed)
    inputs, targets = trainer.sequences.one_step(256, 8, generator)
    with torch.no_grad():
        output = trainer.model.network(inputs.token)
        change = inputs.change(output)
        return float(one_step_loss(change, targets, trainer.weights, 0.01))


@pytest.mark.parametrize(("name", "network"), slow_but(CASES[:2], CASES))
def test_the_loss_falls_and_checkpoints_load(name, network, tmp_path, seed):
    scene = load_scene(name)
    trainer = make_trainer(scene, replace(BRIEF, network=network, seed=seed), tmp_path)
    before = loss_of(trainer, seed)
    model = trainer.run()
    assert loss_of(trainer, seed) < 0.9 * before
    start = initial_states(trainer.source, 5, seed)
    expected = open_loop(NeRDDynamics(model), start, 20)
    for name in ("last", "best"):
        loaded = load_checkpoint(tmp_path / name)
        assert loaded.config == NETWORKS[network] and loaded.scene is scene
        path = open_loop(NeRDDynamics(loaded), start, 20)
        assert path.isfinite().all()
        if name == "last":
            assert torch.equal(path, expected)
    card = read_json(tmp_path / "best" / "card.json")
    assert card["training"]["network"] == network
    assert set(card["validation_error"]) == {"2", "5"}


@pytest.mark.parametrize(
    ("name", "step"),
    slow_but(
        [("cartpole", "unconstrained")],
        [("cartpole", "unconstrained"), ("double_pendulum", "penalty-contact-1-stage")],
    ),
)
def test_a_hybrid_learns_too(name, step, tmp_path, seed):
    scene = load_scene(name)
    config = replace(BRIEF, network="mlp-2x64", step=step, seed=seed, steps=80)
    config = replace(config, single_step_fraction=1.0)
    trainer = make_trainer(scene, config, tmp_path)
    before, start = loss_of(trainer, seed), initial_states(scene, 5, seed)
    path = open_loop(NeRDDynamics(trainer.run()), start, 20)
    assert loss_of(trainer, seed) < before and path.isfinite().all()
    again = load_checkpoint(tmp_path / "last")
    assert again.kind == "hybrid"
    assert torch.equal(open_loop(NeRDDynamics(again), start, 20), path)
    with pytest.raises(ValueError, match="without use_symmetry for a hybrid"):
        make_trainer(scene, replace(config, use_symmetry=True), tmp_path / "other")


def learn(network, share, folder, seed):
    """A trainer after a brief run, a share of it in bfloat16; its loss before."""
    config = replace(BRIEF, network=network, bf16_fraction=share, seed=seed)
    trainer = make_trainer(SCENE, config, folder)
    before = loss_of(trainer, seed)
    for _ in range(BRIEF.steps):
        trainer.update()
        trainer.step += 1
    return trainer, before


@pytest.mark.parametrize("network", slow_but(["mlp-4x64"], NETWORK_NAMES))
def test_bfloat16_learns_as_much_and_leaves_weights_and_outputs_alone(
    network, tmp_path, seed, monkeypatch
):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx512_bf16": True})
    losses, learned = [], []
    for share in (0.0, 1.0):
        trainer, before = learn(network, share, tmp_path / str(share), seed)
        losses.append(loss_of(trainer, seed))
        weights = list(trainer.model.network.parameters())
        assert {weight.dtype for weight in weights} == {torch.float32}
        assert losses[-1] < 0.9 * before
        learned.append(torch.nn.utils.parameters_to_vector(weights))
    # It was used. Weights tell: two losses of a GRU may round to one float.
    assert not torch.equal(*learned)
    assert abs(losses[1] / losses[0] - 1.0) < 0.1


def test_a_processor_without_bfloat16_learns_in_float32(tmp_path, seed, monkeypatch):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx2": True})
    learned = []
    for share in (0.0, 1.0):
        trainer, _ = learn("mlp-2x64", share, tmp_path / str(share), seed)
        weights = trainer.model.network.parameters()
        learned.append(torch.nn.utils.parameters_to_vector(weights))
    assert torch.equal(*learned)


def test_the_log_has_every_validation_once(tmp_path):
    make_trainer(SCENE, BRIEF, tmp_path).run()
    rows = TrainingLog(tmp_path, BRIEF.total_steps).rows
    assert [row["step"] for row in rows] == ["20", "40", "45"]
    assert all(float(value) >= 0.0 for row in rows for value in row.values())


def test_a_log_is_replaced_and_never_cut(tmp_path):
    """Whoever reads, or dies, in the midst of a write has the old log or the new one."""
    log = TrainingLog(tmp_path, 0)
    log.write({"step": 1, "loss": 0.5})
    old = (tmp_path / "log.csv").read_text()
    with open(tmp_path / "log.csv") as reader:
        log.write({"step": 2, "loss": 0.25})
        assert reader.read() == old
    assert [row["step"] for row in TrainingLog(tmp_path, 2).rows] == ["1", "2"]


def test_rows_after_the_resumed_step_are_dropped(tmp_path):
    log = TrainingLog(tmp_path, 0)
    for step in (10, 20, 30):
        log.write({"step": step, "loss": 1.0 / step})
    log = TrainingLog(tmp_path, 20)
    log.write({"step": 30, "loss": 0.5})
    rows = TrainingLog(tmp_path, 30).rows
    assert [row["step"] for row in rows] == ["10", "20", "30"]
    assert float(rows[-1]["loss"]) == 0.5


@pytest.mark.parametrize(
    "change", [{"steps": 41}, {"network": "mlp-4x64"}, {"seed": 1}, {"lr": 0.02}]
)
def test_another_configuration_is_refused_and_nothing_lost(change, tmp_path):
    make_trainer(SCENE, BRIEF, tmp_path).run(until=15)
    before = {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}
    ((name, value),) = change.items()
    told = f"{tmp_path} holds a run with config.{name} {getattr(BRIEF, name)}, "
    with pytest.raises(ValueError) as raised:
        make_trainer(SCENE, replace(BRIEF, **change), tmp_path)
    assert str(raised.value) == f"{told}asked for {value}: choose another folder"
    after = {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}
    assert after == before and len(before) >= 4


def test_other_data_are_refused(tmp_path):
    """As many trajectories of the same robot, from another seed."""
    make_trainer(SCENE, BRIEF, tmp_path).run(until=15)
    data = trajectories(SCENE, 12)
    other = simulate(SCENE, *data.batch_size, Generator().manual_seed(1))
    with pytest.raises(ValueError, match=f"{tmp_path} holds a run with data"):
        Trainer(SCENE, other, SCENE, BRIEF, tmp_path, quiet=True)


def test_another_robot_is_refused(tmp_path):
    make_trainer(SCENE, BRIEF, tmp_path).run(until=15)
    with pytest.raises(ValueError, match=f"{tmp_path} holds a run with scene_hash"):
        make_trainer(OTHER, BRIEF, tmp_path)


@pytest.mark.parametrize(
    ("change", "longest"),
    [
        ({"sequence_length": 13}, 13),
        ({"rollout_length": 14}, 14),
        ({"sequence_length": 20}, 20),
    ],
)
def test_too_short_trajectories_are_refused(change, longest, tmp_path):
    with pytest.raises(ValueError, match=f"at least {longest} steps, got 12"):
        make_trainer(SCENE, replace(BRIEF, **change), tmp_path)
    unused = replace(BRIEF, rollout_length=14, rollout_steps=0)
    make_trainer(SCENE, unused, tmp_path / "unused")


def test_unusable_settings_are_refused(tmp_path):
    for name in ("steps", "rollout_steps", "lr", "ema", "seed"):
        with pytest.raises(ValueError, match=f"{name} of at least [01], got -1"):
            TrainConfig(**{name: -1})
    with pytest.raises(ValueError, match="unknown network 'huge', expected.*mlp"):
        make_trainer(SCENE, replace(BRIEF, network="huge"), tmp_path / "huge")
    (tmp_path / "taken").write_text("not a folder")
    with pytest.raises(ValueError, match=f"{tmp_path / 'taken'}/.* cannot be written"):
        make_trainer(SCENE, BRIEF, tmp_path / "taken")


@pytest.mark.parametrize(
    "name",
    [
        "batch_size",
        "sequence_length",
        "rollout_batch_size",
        "rollout_length",
        "save_every",
        "validate_every",
    ],
)
def test_counts_of_zero_are_refused(name):
    """An empty batch has no loss, and nothing happens every zero updates."""
    with pytest.raises(ValueError, match=f"{name} of at least 1, got 0"):
        TrainConfig(**{name: 0})


@pytest.mark.parametrize("network", NETWORK_NAMES)
def test_every_weight_has_one_optimizer(network, tmp_path):
    trainer = make_trainer(SCENE, replace(BRIEF, network=network), tmp_path)
    matrices, others = split_parameters(trainer.model.network)
    ids = [id(weight) for weight in (*matrices, *others)]
    parameters = list(trainer.model.network.parameters())
    assert sorted(ids) == sorted(map(id, parameters))
    assert all(weight.ndim == 2 for weight in matrices)
    trainer.run(until=3)
    for name, weights in (("muon", matrices), ("adamw", others)):
        held = trainer.optimizers[name].param_groups[0]["params"]
        assert list(map(id, held)) == list(map(id, weights))


def test_step_sizes_rise_and_fall_to_zero_in_both_phases(tmp_path):
    config = replace(BRIEF, steps=30, rollout_steps=10, warmup=10)
    trainer = make_trainer(SCENE, config, tmp_path)
    sizes = []
    for trainer.step in range(config.total_steps):
        trainer.update()
        sizes.append(float(trainer.lr_ratio))
    first, second = sizes[:30], sizes[30:]
    top = first.index(max(first))
    assert first[: top + 1] == sorted(first[: top + 1]) and 7 <= top <= 10
    assert first[top:] == sorted(first[top:], reverse=True) and first[-1] < 0.05
    assert second[0] == pytest.approx(config.rollout_lr_ratio)
    assert second == sorted(second, reverse=True) and second[-1] < 0.02


@pytest.mark.parametrize("ratio", [0.0, 0.3, 1.0])
def test_a_share_of_an_update_is_one_at_that_share_of_the_learning_rate(
    ratio, generator
):
    """In both optimizers, and with their averages of earlier gradients."""
    start = torch.randn(6, 4, generator=generator)
    grads = torch.randn(3, 6, 4, generator=generator)
    ends = []
    for is_shared in (True, False):
        weights = [nn.Parameter(start.clone()) for _ in range(2)]
        lr = 0.1 if is_shared else 0.1 * ratio
        optimizers = {
            "muon": Muon(weights[:1], lr),
            "adamw": make_adamw(weights[1:], lr, torch.device("cpu")),
        }
        for grad in grads:
            for weight in weights:
                weight.grad = grad.clone()
            share = torch.tensor(ratio if is_shared else 1.0)
            with torch.no_grad():
                follow_gradient(weights, optimizers, torch.tensor(1.0), share)
        ends.append(torch.stack(weights).detach())
    torch.testing.assert_close(*ends)
    assert torch.equal(ends[0][0], start) == (ratio == 0.0)


def test_rollouts_begin_anew_in_every_round():
    config = replace(BRIEF, rollout_steps=6, rollout_restarts=3, rollout_lr_ratio=0.5)
    rates = [learning_rate_ratio(config, step) for step in range(config.total_steps)]
    assert rates[config.steps :] == pytest.approx([0.5, 0.25] * 3)
    assert rates[config.warmup : config.steps] == pytest.approx(
        [1.0 - step / config.steps for step in range(config.warmup, config.steps)]
    )
