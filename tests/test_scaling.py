"""The scaling curves at a tiny budget: one point each, and what is done is not redone."""

import pytest
import scaling
import scaling_error
import torch
from tensordict import TensorDict

from torchrl_nerd.modules.networks import NETWORKS
from torchrl_nerd.robots import load_scene


def test_every_scene_and_batch_is_a_point(seed, tmp_path):
    curves = tmp_path / "curves.json"
    points = scaling.main(
        scaling.Options(("cartpole",), (1, 3), seed=seed, json=curves)
    )
    assert [(p.scene, p.rows) for p in points] == [("cartpole", 1), ("cartpole", 3)]
    for p in points:
        assert min(p.mujoco_us, p.learned_us, p.ratio) > 0.0
        assert p.dofs == load_scene(p.scene).model.nv and p.contacts == 0.0
    assert curves.exists()
    assert scaling.memory_table().keys() == NETWORKS.keys()


def test_contacts_are_those_of_mujoco(generator):
    """A cube that stands on its plane has a contact at each of four corners."""
    scene = load_scene("cube")
    rows = int(torch.randint(1, 9, (), generator=generator))
    low = torch.rand(rows, generator=generator) < 0.5
    state, _ = scene.sample_initial(rows, generator)
    state["qpos"][:, 3:7] = torch.tensor([1.0, 0.0, 0.0, 0.0]).double()
    scene.place_on_terrain(state, torch.where(low, -1e-4, 0.5).double())
    found = scaling.mean_contacts(scene, TensorDict(state, [rows]))
    assert found == pytest.approx(4.0 * float(low.double().mean()))


def test_a_size_that_was_measured_is_read(seed, tmp_path, monkeypatch):
    options = scaling_error.Options(
        trajectories=(2, 3), networks=("mlp-1x16",), updates=(1, 2), rows=2, seed=seed
    )
    options.out, options.horizons = tmp_path, (1,)
    first = scaling_error.main(options)
    assert [(x["network"], x["transitions"], x["updates"]) for x in first] == [
        ("mlp-1x32", 200, 2),
        ("mlp-1x32", 300, 2),
        ("mlp-1x32", 300, 1),
        ("mlp-1x16", 300, 2),
    ]
    assert all(x["seconds"] >= 0.0 for x in first)
    monkeypatch.setattr(scaling_error, "Trainer", None)  # nothing is trained again
    assert scaling_error.main(options) == first
    options.updates = (3,)
    with pytest.raises(TypeError):
        scaling_error.main(options)
