"""A training update waits for no number of its device, and is the same compiled."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from dynamics_helpers import little_data
from helpers import slow_but
from meta_helpers import META, meta  # noqa: F401
from tensordict import TensorDict

from torchrl_nerd.compiled import Compiled
from torchrl_nerd.configs import TrainConfig
from torchrl_nerd.robots import SCENES, load_scene, source_of
from torchrl_nerd.training.sequences import Inputs
from torchrl_nerd.training.trainer import Trainer

CONFIG = TrainConfig(
    steps=1,
    rollout_steps=1,
    batch_size=8,
    sequence_length=2,
    rollout_batch_size=4,
    rollout_length=2,
    single_step_fraction=0.0,
)
NETWORKS = ("transformer-2x64", "mlp-2x32")


def make_trainer(name: str, config: TrainConfig, folder: Path, **how) -> Trainer:
    scene = load_scene(name)
    data, source = little_data(scene), source_of(scene)
    return Trainer(
        scene, data, source, config, folder, horizons=(2,), quiet=True, **how
    )


def move_to_meta(trainer: Trainer) -> None:
    """Weights, their average, optimizers and data; nothing is computed any more."""
    trainer.device = META
    trainer.lr_ratio, trainer.ema_share = (torch.ones((), device=META) for _ in "12")
    trainer.model.to(META)
    trainer.weights = trainer.weights.to(META)
    trainer.optimizers = trainer.make_optimizers()
    trainer.average = {k: v.to(META) for k, v in trainer.average.items()}
    sequences = trainer.sequences
    sequences.targets = sequences.targets.to(META)
    sequences.inputs = Inputs(*(x.to(META) for x in sequences.inputs))
    sequences.data = TensorDict(
        {key: value.to(META) for key, value in sequences.data.items(True, True)},
        sequences.data.batch_size,
    )
    if sequences.symmetry is not None:
        sequences.symmetry = sequences.symmetry.to(META)


@pytest.mark.parametrize("name", slow_but(("cartpole", "ant"), SCENES))
@pytest.mark.parametrize("network", slow_but(NETWORKS[:1], NETWORKS))
def test_updates_read_nothing(name, network, meta, tmp_path):  # noqa: F811
    """One of each kind; symmetry augmentation where a robot has symmetries."""
    is_symmetric = name == "ant"
    config = replace(CONFIG, network=network, use_symmetry=is_symmetric)
    trainer = make_trainer(name, config, tmp_path)
    move_to_meta(trainer)
    for trainer.step in (0, 1):
        loss = trainer.update()
        assert loss.device == META and loss.shape == ()
    weights = trainer.model.network.parameters()
    assert all(weight.device == META for weight in weights)


def test_compiled_updates_are_the_eager_ones(tmp_path):
    losses = []
    for is_compiled in (False, True):
        trainer = make_trainer(
            "cartpole", CONFIG, tmp_path / str(is_compiled), compile=is_compiled
        )
        if is_compiled:  # its tracer alone, which takes no minutes
            for name in ("one_step", "bfloat16"):
                assert isinstance(loss := trainer.losses[name], Compiled)
                loss.options = {"backend": "eager", "fullgraph": True}
        losses.append([trainer.update() for trainer.step in (0, 1)])
    torch.testing.assert_close(losses[0], losses[1])


def test_a_batch_that_is_not_finite_counts_nothing(tmp_path, monkeypatch):
    trainer = make_trainer("cartpole", CONFIG, tmp_path)
    before = {k: v.clone() for k, v in trainer.model.network.state_dict().items()}
    monkeypatch.setattr(trainer.sequences, "targets", trainer.sequences.targets / 0)
    trainer.update()
    after = trainer.model.network.state_dict()
    assert all(torch.equal(after[k], v) for k, v in before.items())


@pytest.mark.gpu
def test_captured_updates_are_the_eager_ones(tmp_path):
    """In both precisions and over rollouts: as a CUDA graph and kernel by kernel."""
    config = replace(CONFIG, steps=3, rollout_steps=2, bf16_fraction=0.4)
    losses = []
    for is_captured in (True, False):
        folder = tmp_path / str(is_captured)
        trainer = make_trainer("ant", config, folder, device="cuda")
        if not is_captured:
            trainer._follow = {k: x.function for k, x in trainer._follow.items()}
        losses.append([trainer.update() for trainer.step in range(config.total_steps)])
    torch.testing.assert_close(*losses, rtol=1e-3, atol=1e-4)
